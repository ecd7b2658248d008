/* Polygons as pygame draws them, to the pixel: gfxdraw's anti-aliased outline and its filled polygon, and
   draw.polygon, which rounds in another way. The rules were read from pygame-ce 2.5 (SDL_gfx's primitives and draw.c)
   and are restated here; worker.render.check holds them against the installed pygame. */

#include "canvas.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define MIN(a, b) ((a) < (b) ? (a) : (b))
#define MAX(a, b) ((a) > (b) ? (a) : (b))

/* ---- what a shape leaves behind ---- */

static void mark(Canvas *canvas, int row, int left, int right)
{
    if (row < 0 || row >= HEIGHT)
        return;
    left = MAX(left, 0);
    right = MIN(right, WIDTH - 1);
    if (left > right)
        return;
    int first = canvas->across.low[left], count = canvas->across.high[right] - first + 1;
    memset(&canvas->dirty[canvas->down.low[row]][first], 1, (size_t)count);
    if (canvas->down.high[row] != canvas->down.low[row])
        memset(&canvas->dirty[canvas->down.high[row]][first], 1, (size_t)count);
}

static void push(Canvas *canvas, int row, int left, int right, int alpha, uint32_t colour)
{
    int32_t index = canvas->count;
    if (index == MAX_OPS) {
        canvas->overflow = true;
        return;
    }
    canvas->count++;
    canvas->ops[index] = (Op){-1, (int16_t)left, (int16_t)right, colour & 0xffffff, (uint8_t)alpha};
    if (canvas->tail[row] < 0)
        canvas->head[row] = index;
    else
        canvas->ops[canvas->tail[row]].next = index;
    canvas->tail[row] = index;
}

/* One pixel of an outline; `y` counts upwards as gymnasium draws. */
static void dot(Canvas *canvas, int x, int y, int alpha, uint32_t colour)
{
    int row = HEIGHT - 1 - y;
    if (alpha == 0 || (unsigned)row >= SCENE || (unsigned)x >= WIDTH)
        return;
    int up = canvas->down.low[row], under = canvas->down.high[row];
    int left = canvas->across.low[x], right = canvas->across.high[x];
    canvas->dirty[up][left] = canvas->dirty[up][right] = 1;
    canvas->dirty[under][left] = canvas->dirty[under][right] = 1;
    push(canvas, row, x, x, alpha, colour);
}

/* A run of an outline, or of a solid shape: its cells are dirty. */
static void run(Canvas *canvas, int left, int right, int row, uint32_t colour)
{
    if (left > right) {
        int swap = left;
        left = right;
        right = swap;
    }
    left = MAX(left, 0);
    right = MIN(right, WIDTH - 1);
    if ((unsigned)row >= HEIGHT || left > right)
        return;
    mark(canvas, row, left, right);
    push(canvas, row, left, right, 255, colour);
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

/* Wu's line without its last pixel: two weighted pixels a step along the longer axis. */
static void line(Canvas *canvas, Point a, Point b, uint32_t colour)
{
    if (!clip(&a, &b))
        return;
    Point low = a.y > b.y ? b : a, high = a.y > b.y ? a : b;
    int dx = high.x - low.x, dy = high.y - low.y;
    if (dx == 0) {
        if (dy == 0)
            dot(canvas, a.x, a.y, 255, colour);
        for (int y = low.y; dy > 0 && y <= high.y; y++)
            dot(canvas, a.x, y, 255, colour);
        return;
    }
    if (dy == 0) {
        int row = HEIGHT - 1 - a.y;
        if (row < SCENE)
            run(canvas, low.x, high.x, row, colour);
        return;
    }
    int step = dx > 0 ? 1 : -1;
    dx = abs(dx);
    dot(canvas, a.x, a.y, 255, colour); /* the first pixel as it was given, not the lower one */
    bool steep = dy > dx;
    int longer = steep ? dy : dx, shorter = steep ? dx : dy;
    uint32_t error = 0, slope = (uint32_t)((shorter << 16) / longer) << 16;
    int x = low.x, y = low.y;
    while (--longer) {
        uint32_t before = error;
        error += slope;
        bool turned = error <= before;
        int weight = (int)(error >> 24);
        if (steep) {
            x += turned ? step : 0;
            y++;
        }
        else {
            y += turned;
            x += step;
        }
        dot(canvas, x, y, 255 * (255 - weight) >> 8, colour);
        dot(canvas, steep ? x + step : x, steep ? y : y + 1, 255 * weight >> 8, colour);
    }
}

void canvas_outline(Canvas *canvas, const Point *points, int count, uint32_t colour)
{
    for (int i = 0; i < count; i++)
        line(canvas, points[i], points[(i + 1) % count], colour);
}

/* ---- the filled polygon ---- */

enum { MAX_POINTS = 16 };

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
            uint32_t part = (uint32_t)((65536 * (y - low.y)) / (high.y - low.y));
            found[n++] = (int)(part * (uint32_t)(high.x - low.x) + 65536u * (uint32_t)low.x);
        }
    }
    sort(found, n);
    return n;
}

/* Colours the clean cells whose middle row this is: those whose middle column lies in the run. */
static void colour_cells(Canvas *canvas, int row, int left, int right, uint32_t colour)
{
    int i = canvas->middle[row];
    if (i < 0)
        return;
    const Axis *across = &canvas->across;
    for (int j = across->low[left]; j <= across->high[right]; j++) {
        int centre = (across->first[j] + across->last[j]) / 2;
        if (centre >= left && centre <= right)
            canvas->colour[i][j] = colour;
    }
}

typedef struct {
    int count, left, right;
} Line;

/* Marks what lies between two neighbouring scan lines' ends, where the boundary passes. */
static void mark_between(Canvas *canvas, int row, Line above, Line here)
{
    if (above.count != 1 || here.count != 1) {
        int left = MIN(above.left, here.left), right = MAX(above.right, here.right);
        if (!above.count)
            left = here.left, right = here.right;
        if (!here.count)
            left = above.left, right = above.right;
        mark(canvas, row, left, right);
        return;
    }
    mark(canvas, row, MIN(above.left, here.left), MAX(above.left, here.left));
    mark(canvas, row, MIN(above.right, here.right), MAX(above.right, here.right));
}

void canvas_fill(Canvas *canvas, const Point *points, int count, uint32_t colour)
{
    int top = points[0].y, bottom = points[0].y, found[MAX_POINTS];
    for (int i = 1; i < count; i++) {
        top = MIN(top, points[i].y);
        bottom = MAX(bottom, points[i].y);
    }
    Line before = {0, 0, 0};
    int first = MAX(top, HEIGHT - SCENE - 1), last = MIN(bottom, HEIGHT - 1);
    for (int y = first; y <= last; y++) {
        int row = HEIGHT - 1 - y, n = crossings(points, count, y, bottom, found);
        Line here = {n / 2, WIDTH, -1};
        for (int i = 0; i + 1 < n; i += 2) {
            int a = found[i] + 1, b = found[i + 1] - 1;
            int left = (int16_t)((a >> 16) + ((a & 32768) >> 15)), right = (int16_t)((b >> 16) + ((b & 32768) >> 15));
            if (left > right) {
                int swap = left;
                left = right;
                right = swap;
            }
            here.left = MIN(here.left, left);
            here.right = MAX(here.right, right);
            left = MAX(left, 0);
            right = MIN(right, WIDTH - 1);
            if (row < SCENE && left <= right) {
                push(canvas, row, left, right, FILL, colour);
                colour_cells(canvas, row, left, right, colour);
            }
        }
        if (y == top)
            mark(canvas, row, here.left, here.right);
        else
            mark_between(canvas, row, y == first ? here : before, here);
        if (y == bottom)
            mark(canvas, row, here.left, here.right);
        before = here;
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
        run(canvas, low_x, high_x, ROW(top), colour);
        return;
    }
    for (int line = MAX(top, 0); line <= MIN(bottom, HEIGHT - 1); line++) {
        int n = 0;
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
        for (int i = 0; i + 1 < n; i += 2)
            run(canvas, found[i], found[i + 1], ROW(line), colour);
    }
    for (int i = 0, before = count - 1; i < count; before = i++)
        if (top < y[i] && y[before] == y[i] && y[i] < bottom)
            run(canvas, x[i], x[before], ROW(y[i]), colour);
    for (int line = MAX(top, 0); line <= MIN(bottom, HEIGHT - 1); line++)
        mark(canvas, ROW(line), low_x, high_x);
#undef ROW
}
