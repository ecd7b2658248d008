/* The interior of a polygon of which every line crosses two edges. Compiled again for wider instructions, as band.c. */

#include "span.h"

/* The crossings of rows `top` to `bottom` (clipped) with one edge. A double's quotient is exact here: half a unit more
   outweighs its error, and is less than what lacks to the next whole quotient. */
static void walk_edge(Point low, Point high, int top, int bottom, bool last, int *found)
{
    int from = MAX(HEIGHT - 1 - high.y + !last, top), to = MIN(HEIGHT - 1 - low.y, bottom);
    double once = 1.0 / (high.y - low.y);
    uint32_t dx = (uint32_t)(high.x - low.x), start = 65536u * (uint32_t)low.x;
    for (int row = from; row <= to; row++) {
        uint32_t part = (uint32_t)(int)((65536.0 * (HEIGHT - 1 - row - low.y) + 0.5) * once);
        found[row - top] = (int)(part * dx + start);
    }
}

void fill_spans(Span *spans, int top, int bottom, const Point *points, int count, int highest)
{
    int up[HEIGHT], down[HEIGHT]; /* the crossing with either side */
    for (int i = 0; i < count; i++) {
        Point a = points[i], b = points[(i + 1) % count];
        if (a.y < b.y)
            walk_edge(a, b, top, bottom, b.y == highest, up);
        else if (a.y > b.y)
            walk_edge(b, a, top, bottom, a.y == highest, down);
    }
    for (int i = 0; i <= bottom - top; i++)
        spans[i] = between(MIN(up[i], down[i]), MAX(up[i], down[i]));
}
