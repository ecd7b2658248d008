/* The surface that gymnasium draws on, of which only what an output pixel can notice is ever filled in, one row of
   output cells at a time: what is drawn on stays within the processor's nearest cache.

   An output cell is the source rectangle that one pixel of the 96x96 observation averages. A cell that one shape
   covers wholly has one colour and is never drawn; only the others ("dirty" cells) get real pixels. Rows count from the
   top of the final picture, after gymnasium's vertical flip: row = 799 - y. */
#ifndef DREAMFLEET_CANVAS_H
#define DREAMFLEET_CANVAS_H

#include <stdbool.h>
#include <stdint.h>

#define MIN(a, b) ((a) < (b) ? (a) : (b))
#define MAX(a, b) ((a) > (b) ? (a) : (b))

enum {
    WIDTH = 1000,
    HEIGHT = 800,
    CELLS = 96,      /* across and down */
    SMALL = 64,      /* across and down, of the small picture */
    SCENE_ROWS = 84, /* rows of cells above the indicator bar */
    SCENE = 700,     /* source rows above it */
    BAND = 12,       /* source rows of a row of cells, at most */
    CELL = 12,       /* source columns of a cell, at most; 11 at least */
    MARGIN = 16,     /* pixels beside a band, where an outline may step out by one */
    STRIDE = 1040,   /* pixels from a band's row to the next: whole cache lines, and no power of two */
    MAX_SHAPES = 2048,
    MAX_SPANS = 1 << 18,
    MAX_EDGES = 4,
    WORDS = MAX_SHAPES / 64,
};

typedef struct {
    int16_t x, y; /* y upwards, as gymnasium draws */
} Point;

typedef struct {
    int16_t left, right; /* both included; WIDTH and -1 if there is none */
} Span;

/* One side of an anti-aliased outline. */
typedef struct {
    enum { LEVEL, UPRIGHT, STEEP, SHALLOW } kind;
    Point low, high, first; /* `first` is opaque and is drawn first */
    int step;               /* of x along the way from low to high: 1 or -1 */
    int longer;             /* steps along the longer axis, both ends included */
    uint32_t slope;         /* of the shorter axis, in units of 2^-16 pixels a step */
} Edge;

/* An outline and the interior that is drawn over it: at most one span a row. */
typedef struct {
    uint32_t colour;
    int edges;
    Edge edge[MAX_EDGES];
    int top, bottom;   /* rows of the interior */
    const Span *spans; /* of row `top` and on */
} Shape;

/* Which source pixels a cell averages along one axis: the first and last in part, those between in full. */
typedef struct {
    int first[CELLS], last[CELLS];
    uint16_t first_weight[CELLS], last_weight[CELLS];
    uint16_t reciprocal;
    uint16_t ends[CELLS][16]; /* weights of the first two and the last two of CELL pixels, four times each */
    uint8_t low[WIDTH], high[WIDTH]; /* the one or two cells that a source pixel belongs to */
    uint8_t after[WIDTH];            /* the first cell that begins at or after this pixel, or CELLS */
    int8_t before[WIDTH];            /* the last cell that ends at or before it, or -1 */
} Axis;

typedef struct {
    int top, bottom; /* source rows that are drawn on */
    int count;
    Shape shapes[MAX_SHAPES];
    uint64_t active[WORDS][CELLS]; /* which shapes a row of cells meets, a bit each */
    int spans_used;
    Span spans[MAX_SPANS];
    bool overflow; /* more was drawn than there is room for; the caller must not trust the picture */
    _Alignas(64) uint32_t band[BAND + 2][STRIDE]; /* one row more above and below, which an outline may touch */
    Axis across, down;
} Canvas;

void canvas_init(Canvas *canvas);

/* Draw on these source rows only. */
void canvas_begin(Canvas *canvas, int top, int bottom);

/* Shapes, in the order in which they lie on each other. */
void canvas_polygon(Canvas *canvas, const Point *points, int count, uint32_t colour);
void canvas_solid(Canvas *canvas, const int *x, const int *y, int count, uint32_t colour, bool flipped);

/* Cell rows `from` to `to` of the finished picture: out is (to - from) x 96 x 3 bytes. */
typedef void CanvasFinish(Canvas *canvas, uint32_t background, int from, int to, uint8_t *out);
CanvasFinish canvas_finish;

/* The 64x64 picture of the 84 rows of cells above the bar. */
typedef void CanvasShrink(const uint8_t *source, uint8_t *target);
CanvasShrink canvas_shrink;

/* The spans of rows `top` to `bottom` of a polygon of which every line crosses two edges; `highest` is its last y. */
typedef void CanvasFill(Span *spans, int top, int bottom, const Point *points, int count, int highest);
CanvasFill canvas_fill;

/* Draws with the processor's widest instructions up to 0 (none), 1 (AVX2) or 2 (AVX-512); says with which. They change
   no bit; to do without is for comparing. */
int canvas_widen(int most);

/* What canvas_finish, canvas_shrink and canvas_fill choose from. */
CanvasFinish band_finish;
CanvasShrink box_shrink;
CanvasFill fill_spans;
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define DREAMFLEET_WIDE
CanvasFinish band_finish_avx2, band_finish_avx512;
CanvasShrink box_shrink_avx2, box_shrink_avx512;
CanvasFill fill_spans_avx2, fill_spans_avx512;
#endif

#endif
