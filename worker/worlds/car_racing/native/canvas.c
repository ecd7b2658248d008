/* What a canvas knows before anything is drawn on it: which source pixels a cell averages, as pygame's smoothscale. */

#include "canvas.h"

#include <string.h>

enum { ONE = 1 << 14 }; /* a whole source pixel's weight */

static void axis_init(Axis *axis, int length)
{
    int space = ONE * length / CELLS, left = space, cell = 0, first = 0;
    uint16_t weight = 0; /* of the pixel that the cell before took in part */
    axis->reciprocal = (uint16_t)((1 << 30) / space);
    memset(axis->low, 0xff, sizeof axis->low);
    for (int pixel = 0; pixel < length && cell < CELLS; pixel++) {
        if (left > ONE) {
            left -= ONE;
            continue;
        }
        axis->first[cell] = first;
        axis->first_weight[cell] = weight;
        axis->last[cell] = pixel;
        axis->last_weight[cell] = (uint16_t)left;
        weight = (uint16_t)(ONE - left);
        left = space - weight;
        first = pixel;
        cell++;
    }
    for (int j = 0; j < CELLS; j++) {
        bool full = axis->last[j] - axis->first[j] == CELL - 1;
        uint16_t weights[4] = {j > 0 ? axis->first_weight[j] : ONE, ONE, full ? ONE : axis->last_weight[j],
                               full ? axis->last_weight[j] : 0};
        for (int lane = 0; lane < 16; lane++)
            axis->ends[j][lane] = weights[lane / 4];
        for (int pixel = axis->first[j]; pixel <= axis->last[j]; pixel++) {
            if (axis->low[pixel] == 0xff)
                axis->low[pixel] = (uint8_t)j;
            axis->high[pixel] = (uint8_t)j;
        }
    }
    for (int pixel = axis->last[CELLS - 1] + 1; pixel < length; pixel++)
        axis->low[pixel] = axis->high[pixel] = CELLS - 1; /* no cell takes it; harmless to draw */
    for (int pixel = 0, after = 0, before = -1; pixel < length; pixel++) {
        while (after < CELLS && axis->first[after] < pixel)
            after++;
        while (before + 1 < CELLS && axis->last[before + 1] <= pixel)
            before++;
        axis->after[pixel] = (uint8_t)after;
        axis->before[pixel] = (int8_t)before;
    }
}

static CanvasFinish *finish;
static CanvasShrink *shrink;
static CanvasFill *fill;

int canvas_widen(int most)
{
#ifdef DREAMFLEET_WIDE
    if (most >= 2 && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("bmi2")) {
        finish = band_finish_avx512;
        shrink = box_shrink_avx512;
        fill = fill_spans_avx512;
        return 2;
    }
    if (most >= 1 && __builtin_cpu_supports("avx2")) {
        finish = band_finish_avx2;
        shrink = box_shrink_avx2;
        fill = fill_spans_avx2;
        return 1;
    }
#endif
    (void)most;
    finish = band_finish;
    shrink = box_shrink;
    fill = fill_spans;
    return 0;
}

void canvas_init(Canvas *canvas)
{
    canvas_widen(2);
    axis_init(&canvas->across, WIDTH);
    axis_init(&canvas->down, HEIGHT);
}

void canvas_begin(Canvas *canvas, int top, int bottom)
{
    canvas->top = top;
    canvas->bottom = bottom;
    canvas->count = 0;
    canvas->spans_used = 0;
    canvas->overflow = false;
}

void canvas_finish(Canvas *canvas, uint32_t background, int from, int to, uint8_t *out)
{
    finish(canvas, background, from, to, out);
}

void canvas_shrink(const uint8_t *source, uint8_t *target)
{
    shrink(source, target);
}

void canvas_fill(Span *spans, int top, int bottom, const Point *points, int count, int highest)
{
    fill(spans, top, bottom, points, count, highest);
}
