/* The 64x64 picture of an observation, as worker.worlds.car_racing.preprocessing defines it. Compiled again for wider
   instructions, as band.c. */

#include "canvas.h"

#include <string.h>

enum { LINE = CELLS * 3, SIXTEENTHS = 16 * SCENE_ROWS / SMALL /* of a row, that a smaller row takes */ };

#define THREE(a, b, c) a, a, a, b, b, b, c, c, c
#define OFTEN(three) three, three, three, three, three, three, three, three
#define LINE_OF(a, b, c) {OFTEN(THREE(a, b, c)), OFTEN(THREE(a, b, c)), OFTEN(THREE(a, b, c)), OFTEN(THREE(a, b, c))}
/* The weights of a cell and of the next one. */
static const uint16_t left[LINE] = LINE_OF(2, 1, 0), right[LINE] = LINE_OF(1, 2, 0);

/* A row of the picture from the rows of the observation that it lies on. */
static void shrink_row(const uint8_t *source, int i, uint8_t *target)
{
    uint16_t sums[LINE + 3] = {0}; /* 3 more that nobody looks at */
    int top = SIXTEENTHS * i, skipped = top % 16, rest = SIXTEENTHS + skipped - 32; /* of the first and the third row */
    const uint8_t *first = source + top / 16 * LINE, *second = first + LINE;
    const uint8_t *third = rest > 0 ? second + LINE : second; /* the picture's last row has none */
    uint16_t one = (uint16_t)(16 - skipped), two = (uint16_t)(rest < 0 ? 16 + rest : 16);
    uint16_t three = (uint16_t)(rest > 0 ? rest : 0);
    for (int x = 0; x < LINE; x++)
        sums[x] = (uint16_t)(one * first[x] + two * second[x] + three * third[x]);
    /* Of three cells the first two places become the two pixels; nobody looks at the third. */
    uint8_t pixels[LINE];
    for (int x = 0; x < LINE; x++)
        pixels[x] = (uint8_t)((uint16_t)(left[x] * sums[x] + right[x] * sums[x + 3] + 31) / 63);
    for (int pair = 0; pair < SMALL / 2; pair++)
        memcpy(target + 6 * pair, pixels + 9 * pair, 6);
}

void box_shrink(const uint8_t *source, uint8_t *target)
{
    for (int i = 0; i < SMALL; i++)
        shrink_row(source, i, target + i * SMALL * 3);
}
