/* CarRacing's picture of a race. */
#ifndef DREAMFLEET_SCENE_H
#define DREAMFLEET_SCENE_H

#include "race.h"

enum { PICTURE = 96, SMALL_PICTURE = 64 }; /* pixels across and down, of red, green and blue */

void scene_init(void);

/* Draws with instructions at most so wide, as canvas_widen. */
int scene_widen(int most);

/* gymnasium's observation but for the score's text, and the small picture of its scene. False if the car is too far
   away to be drawn. */
bool scene_draw(const Race *race, uint8_t *out);
bool scene_draw_small(const Race *race, uint8_t *out);

#endif
