/* The 64x64 picture of an observation, as worker.car_racing.preprocessing defines it. Compiled again for wider
   instructions, as band.c. */

#include "canvas.h"

#include <string.h>

enum { LINE = CELLS * 3, SIXTEENTHS = 16 * SCENE_ROWS / SMALL /* of a row, that a smaller row takes */ };

/* A row of the picture from the rows of the observation that it lies on. */
static void shrink_row(const uint8_t *source, int i, uint8_t *target)
{
    uint16_t sums[LINE + 6] = {0}; /* 6 more that nobody looks at */
    int top = SIXTEENTHS * i, bottom = top + SIXTEENTHS;
    for (int row = top / 16; 16 * row < bottom; row++) {
        int low = 16 * row > top ? 16 * row : top, high = 16 * row + 16 < bottom ? 16 * row + 16 : bottom;
        const uint8_t *line = source + row * LINE;
        uint16_t weight = (uint16_t)(high - low);
        for (int x = 0; x < LINE; x++)
            sums[x] = (uint16_t)(sums[x] + weight * line[x]);
    }
    /* Three cells become two: averages for every place, of which each third is one. */
    uint8_t left[LINE], right[LINE];
    for (int x = 0; x < LINE; x++) {
        left[x] = (uint8_t)((uint16_t)(2 * sums[x] + sums[x + 3] + 31) / 63);
        right[x] = (uint8_t)((uint16_t)(sums[x + 3] + 2 * sums[x + 6] + 31) / 63);
    }
    for (int pair = 0; pair < SMALL / 2; pair++) {
        memcpy(target + 6 * pair, left + 9 * pair, 3);
        memcpy(target + 6 * pair + 3, right + 9 * pair, 3);
    }
}

void box_shrink(const uint8_t *source, uint8_t *target)
{
    for (int i = 0; i < SMALL; i++)
        shrink_row(source, i, target + i * SMALL * 3);
}
