/* Polygons as pygame draws them, to the pixel: gfxdraw's anti-aliased outline and its filled polygon, and
   draw.polygon, which rounds in another way. The rules were read from pygame-ce 2.5 (SDL_gfx's primitives and draw.c)
   and are restated here; worker.worlds.car_racing.native_check holds them against the installed pygame. */

#include "span.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_POINTS = 16 };

/* ---- keeping shapes ---- */

static Shape *new_shape(Canvas *canvas, uint32_t colour)
{
    if (canvas->count == MAX_SHAPES) {
        canvas->overflow = true;
        return NULL;
    }
    if (canvas->count % 64 == 0)
        memset(canvas->active[canvas->count / 64], 0, sizeof canvas->active[0]);
    Shape *shape = &canvas->shapes[canvas->count++];
    shape->colour = colour & 0xffffff;
    shape->edges = 0;
    shape->top = 0;
    shape->bottom = -1;
    return shape;
}

/* Lets the rows of cells know that these source rows of the shape concern them. */
static void concern(Canvas *canvas, const Shape *shape, int top, int bottom)
{
    top = MAX(top, canvas->top);
    bottom = MIN(bottom, canvas->bottom);
    if (top > bottom)
        return;
    int index = (int)(shape - canvas->shapes);
    uint64_t *active = canvas->active[index / 64];
    for (int i = canvas->down.low[top]; i <= canvas->down.high[bottom]; i++)
        active[i] |= (uint64_t)1 << index % 64;
}

/* Room for the interior's spans, all still empty; NULL where none of its rows are drawn on. */
static Span *new_spans(Canvas *canvas, Shape *shape, int top, int bottom)
{
    shape->top = MAX(top, canvas->top);
    shape->bottom = MIN(bottom, canvas->bottom);
    int count = shape->bottom - shape->top + 1;
    if (count <= 0)
        return NULL;
    if (canvas->spans_used + count > MAX_SPANS) {
        canvas->overflow = true;
        shape->bottom = shape->top - 1;
        return NULL;
    }
    Span *spans = canvas->spans + canvas->spans_used;
    canvas->spans_used += count;
    shape->spans = spans;
    concern(canvas, shape, shape->top, shape->bottom);
    return spans;
}

/* One run of an interior, as a shape of its own. */
static void run(Canvas *canvas, int row, int left, int right, uint32_t colour)
{
    Shape *shape = new_shape(canvas, colour);
    Span *span = shape ? new_spans(canvas, shape, row, row) : NULL;
    if (span)
        *span = span_of(left, right);
}

/* ---- the anti-aliased outline ---- */

enum { INSIDE = 0, LEFT = 1, RIGHT = 2, BELOW = 4, ABOVE = 8 };

static int outcode(Point p)
{
    int code = p.x < 0 ? LEFT : p.x > WIDTH - 1 ? RIGHT : INSIDE;
    return code | (p.y < 0 ? ABOVE : p.y > HEIGHT - 1 ? BELOW : INSIDE);
}

/* Cohen and Sutherland's clipping, in single precision and with truncation at every step. */
static bool clip(Point *a, Point *b)
{
    for (;;) {
        int code_a = outcode(*a), code_b = outcode(*b);
        if (!(code_a | code_b))
            return true;
        if (code_a & code_b)
            return false;
        if (code_a == INSIDE) {
            Point swap = *a;
            *a = *b;
            *b = swap;
            code_a = code_b;
        }
        bool upright = a->x == b->x;
        float slope = upright ? 1.0f : (float)(b->y - a->y) / (float)(b->x - a->x);
        if (code_a & (LEFT | RIGHT)) {
            int edge = code_a & LEFT ? 0 : WIDTH - 1;
            a->y = (int16_t)(a->y + (int16_t)(int32_t)((float)(edge - a->x) * slope));
            a->x = (int16_t)edge;
        }
        else {
            int edge = code_a & BELOW ? HEIGHT - 1 : 0;
            if (!upright)
                a->x = (int16_t)(a->x + (int16_t)(int32_t)((float)(edge - a->y) / slope));
            a->y = (int16_t)edge;
        }
    }
}

/* Wu's line without its last pixel, still to be drawn: two weighted pixels a step along the longer axis. */
static void add_edge(Canvas *canvas, Shape *shape, Point a, Point b)
{
    if (!clip(&a, &b))
        return;
    Edge *edge = &shape->edge[shape->edges++];
    edge->first = a; /* as it was given, not the lower one */
    edge->low = a.y > b.y ? b : a;
    edge->high = a.y > b.y ? a : b;
    int dx = edge->high.x - edge->low.x, dy = edge->high.y - edge->low.y;
    concern(canvas, shape, HEIGHT - 1 - edge->high.y, HEIGHT - 1 - edge->low.y);
    edge->kind = dy == 0 ? LEVEL : dx == 0 ? UPRIGHT : dy > abs(dx) ? STEEP : SHALLOW;
    if (dx == 0 || dy == 0)
        return;
    edge->step = dx > 0 ? 1 : -1;
    dx = abs(dx);
    edge->longer = MAX(dx, dy);
    edge->slope = (uint32_t)(MIN(dx, dy) << 16) / (uint32_t)edge->longer;
}

/* ---- the filled polygon ---- */

static int ascending(const void *a, const void *b)
{
    int x = *(const int *)a, y = *(const int *)b;
    return (x > y) - (x < y);
}

static void sort(int *values, int count)
{
    if (count == 2) {
        if (values[0] > values[1]) {
            int swap = values[0];
            values[0] = values[1];
            values[1] = swap;
        }
    }
    else
        qsort(values, (size_t)count, sizeof(int), ascending);
}

/* Where scan line y meets the edges, in 16.16; the last line also takes the ends of edges. */
static int crossings(const Point *points, int count, int y, int bottom, int *found)
{
    int n = 0;
    for (int i = 0, before = count - 1; i < count; before = i++) {
        Point low = points[before], high = points[i];
        if (low.y == high.y)
            continue;
        if (low.y > high.y) {
            Point swap = low;
            low = high;
            high = swap;
        }
        if ((y >= low.y && y < high.y) || (y == bottom && y > low.y && y <= high.y)) {
            uint32_t part = (uint32_t)((int64_t)65536 * (y - low.y) / (high.y - low.y));
            found[n++] = (int)(part * (uint32_t)(high.x - low.x) + 65536u * (uint32_t)low.x);
        }
    }
    sort(found, n);
    return n;
}

/* Whether a walk along the edges goes up once and down once, so that every line crosses exactly two. */
static bool two_sided(const Point *points, int count)
{
    int turns = 0, way = 0, first = 0;
    for (int i = 0; i < count; i++) {
        int next = points[(i + 1) % count].y - points[i].y;
        if (next == 0)
            continue;
        next = next > 0 ? 1 : -1;
        turns += way && next != way;
        first = first ? first : next;
        way = next;
    }
    return turns + (way != first) == 2;
}

/* gfxdraw.aapolygon and gfxdraw.filled_polygon over it. */
void canvas_polygon(Canvas *canvas, const Point *points, int count, uint32_t colour)
{
    Shape *shape = new_shape(canvas, colour);
    if (!shape)
        return;
    int low = points[0].y, high = points[0].y, found[MAX_POINTS];
    for (int i = 0; i < count; i++) {
        low = MIN(low, points[i].y);
        high = MAX(high, points[i].y);
        add_edge(canvas, shape, points[i], points[(i + 1) % count]);
    }
    if (low == high)
        return;
    if (two_sided(points, count)) {
        Span *spans = new_spans(canvas, shape, HEIGHT - 1 - high, HEIGHT - 1 - low);
        if (spans)
            canvas_fill(spans, shape->top, shape->bottom, points, count, high);
        return;
    }
    for (int y = MAX(low, HEIGHT - 1 - canvas->bottom); y <= MIN(high, HEIGHT - 1 - canvas->top); y++) {
        int n = crossings(points, count, y, high, found);
        for (int i = 0; i + 1 < n; i += 2) {
            Span span = between(found[i], found[i + 1]);
            run(canvas, HEIGHT - 1 - y, span.left, span.right, colour);
        }
    }
}

/* ---- pygame.draw.polygon ---- */

void canvas_solid(Canvas *canvas, const int *x, const int *y, int count, uint32_t colour, bool flipped)
{
    int top = y[0], bottom = y[0], found[MAX_POINTS], low_x = x[0], high_x = x[0];
    for (int i = 1; i < count; i++) {
        top = MIN(top, y[i]);
        bottom = MAX(bottom, y[i]);
        low_x = MIN(low_x, x[i]);
        high_x = MAX(high_x, x[i]);
    }
#define ROW(y) (flipped ? (y) : HEIGHT - 1 - (y))
    if (top == bottom) {
        run(canvas, ROW(top), low_x, high_x, colour);
        return;
    }
    Shape *shape = new_shape(canvas, colour);
    Span *spans = shape ? new_spans(canvas, shape, MIN(ROW(top), ROW(bottom)), MAX(ROW(top), ROW(bottom))) : NULL;
    if (!spans)
        return;
    for (int row = shape->top; row <= shape->bottom; row++) {
        int line = ROW(row), n = 0;
        for (int i = 0, before = count - 1; i < count; before = i++) {
            int a = y[before] <= y[i] ? before : i, b = a == before ? i : before;
            if (y[a] == y[b])
                continue;
            if ((line >= y[a] && line < y[b]) || (line == bottom && y[b] == bottom)) {
                float offset = (float)((line - y[a]) * (x[b] - x[a])) / (float)(y[b] - y[a]);
                /* rounds outwards by turns, in the order of the edges */
                found[n] = (int)(n % 2 ? ceilf(offset) : floorf(offset)) + x[a];
                n++;
            }
        }
        sort(found, n);
        *spans++ = n > 1 ? span_of(found[0], found[1]) : EMPTY;
        for (int i = 2; i + 1 < n; i += 2)
            run(canvas, row, found[i], found[i + 1], colour);
    }
    for (int i = 0, before = count - 1; i < count; before = i++)
        if (top < y[i] && y[before] == y[i] && y[i] < bottom)
            run(canvas, ROW(y[i]), x[i], x[before], colour);
#undef ROW
}
