/* The surface that gymnasium draws on, of which only what an output pixel can notice is ever filled in, one row of
   output cells at a time: what is drawn on stays within the processor's nearest caches.

   An output cell is the source rectangle that one pixel of the 96x96 observation averages. A cell that no edge passes
   has one colour and is never drawn; only the others ("dirty" cells) get real pixels. Rows count from the top of the
   final picture, after gymnasium's vertical flip: row = 799 - y. */
#ifndef DREAMFLEET_CANVAS_H
#define DREAMFLEET_CANVAS_H

#include <stdbool.h>
#include <stdint.h>

enum {
    WIDTH = 1000,
    HEIGHT = 800,
    CELLS = 96,      /* across and down */
    SCENE_ROWS = 84, /* rows of cells above the indicator bar */
    SCENE = 700,     /* source rows above it */
    BAND = 12,       /* source rows of a row of cells, at most */
    MAX_OPS = 1 << 19,
    MAX_RUNS = CELLS / 2 + 1,
};

typedef struct {
    int16_t x, y;
} Point;

/* A horizontal run of one shape; alpha 255 replaces, less blends. */
typedef struct {
    int32_t next; /* of the same source row, or -1 */
    int16_t left, right;
    uint32_t colour : 24, alpha : 8;
} Op;

/* Runs of an interior are drawn only where cells are dirty; their alpha says so. Single pixels and outlines are not. */
enum { FILL = 0 };

typedef struct {
    int16_t left, right;
} Run;

/* Which source pixels a cell averages along one axis: the first and last in part, those between in full. */
typedef struct {
    int first[CELLS], last[CELLS];
    uint16_t first_weight[CELLS], last_weight[CELLS];
    uint16_t reciprocal;
    uint8_t low[WIDTH], high[WIDTH]; /* the one or two cells that a source pixel belongs to */
    uint8_t plain[CELLS][256];       /* what a cell of one value averages to */
} Axis;

typedef struct {
    uint32_t band[BAND][WIDTH];
    uint8_t dirty[CELLS][CELLS];
    uint32_t colour[CELLS][CELLS]; /* of clean cells */
    int16_t middle[HEIGHT];        /* the cell row whose middle this source row is, or -1 */
    Op ops[MAX_OPS];
    int32_t count, head[HEIGHT], tail[HEIGHT]; /* the first and last run of each source row, or -1 */
    bool overflow; /* more was drawn than there is room for; the caller must not trust the picture */
    Axis across, down;
} Canvas;

void canvas_init(Canvas *canvas);
void canvas_begin(Canvas *canvas, uint32_t background);

/* Shapes, in the order in which they lie on each other. */
void canvas_outline(Canvas *canvas, const Point *points, int count, uint32_t colour);
void canvas_fill(Canvas *canvas, const Point *points, int count, uint32_t colour);
void canvas_solid(Canvas *canvas, const int *x, const int *y, int count, uint32_t colour, bool flipped);

/* Cell rows `from` to `to` of the finished picture: out is (to - from) x 96 x 3 bytes. */
void canvas_finish(Canvas *canvas, uint32_t background, int from, int to, uint8_t *out);

#endif
