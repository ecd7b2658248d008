/* From shapes to pixels, one row of cells at a time: finds its dirty cells, draws inside them only, and averages each
   as pygame's smoothscale does. Compiled again for wider processors, see wide_avx2.c and wide_avx512.c. */

#include "canvas.h"

#include <string.h>
#ifdef __AVX2__
#include <immintrin.h>
#endif

/* ---- what lies in the row of cells ---- */

static int lowest_bit(uint64_t word)
{
#if defined(__GNUC__)
    return __builtin_ctzll(word);
#else
    int bit = 0;
    for (; !(word & 1); word >>= 1)
        bit++;
    return bit;
#endif
}

#define CHANNEL(colour, shift) ((colour) >> (shift) & 255)

/* What a cell of one colour averages to: truncation takes one from each channel that is not 0, along either axis. */
static uint8_t finished(uint32_t colour, int shift)
{
    uint32_t value = CHANNEL(colour, shift);
    return (uint8_t)(value < 2 ? 0 : value - 2);
}

/* What of a shape lies in the band: the part of each edge, and the cells that it touches. */
typedef struct {
    const Edge *edge;
    uint32_t colour;
    int from, to;       /* steps of the edge */
    int low, high;      /* the first and last cell */
} Line;

typedef struct {
    const Shape *shape;
    int top, bottom; /* rows */
    int low, high;   /* cells */
    int lines_end;   /* of the list of lines: this outline is drawn before this interior */
} Patch;

typedef struct {
    uint64_t left, right; /* cells 0 to 63 and those from 64 on, a bit each */
} Cells;

typedef struct {
    int left, right; /* source columns */
    int first;       /* the first shape that can be seen in it */
} DirtyRun;

/* Valid for the row of cells that is being drawn. */
typedef struct {
    int first, top, bottom; /* source rows: of the cells, and those of them that are drawn on */
    uint8_t *out; /* the finished row */
    Patch patches[MAX_SHAPES];
    Line lines[MAX_SHAPES * MAX_EDGES];
    int patch_count, line_count;
    Cells dirty;
    int16_t base[CELLS]; /* the last shape that covers the whole cell, or -1 */
    DirtyRun runs[CELLS];
    int run_count;
} Band;

/* The cells from `low` to `high`, which may be one less than low. */
static Cells cells_between(int low, int high)
{
    uint64_t all = ~(uint64_t)0;
    Cells cells = {0, 0};
    if (low < 64)
        cells.left = all << low & (high < 63 ? ~(all << (high + 1)) : all);
    if (high >= 64)
        cells.right = (low > 64 ? all << (low - 64) : all) & ~(all << (high - 63));
    return cells;
}

static void soil(Band *band, int low, int high)
{
    Cells cells = cells_between(low, high);
    band->dirty.left |= cells.left;
    band->dirty.right |= cells.right;
}

/* Gives cells that one shape covers its colour. */
static void cover(Band *band, int low, int high, uint32_t colour, int index)
{
    uint8_t red = finished(colour, 16), green = finished(colour, 8), blue = finished(colour, 0);
    Cells cells = cells_between(low, high);
    band->dirty.left &= ~cells.left;
    band->dirty.right &= ~cells.right;
    uint8_t *out = band->out + 3 * low;
    for (int j = low; j <= high; j++, out += 3) {
        out[0] = red;
        out[1] = green;
        out[2] = blue;
        band->base[j] = (int16_t)index;
    }
}

/* Which steps of the edge fall into the band, and the columns of their pixels; false if none do. */
static bool clip_edge(const Band *band, const Edge *edge, Line *line, int *left, int *right)
{
    int bottom = HEIGHT - 1 - band->bottom, top = HEIGHT - 1 - band->top; /* y, upwards */
    if (edge->high.y < bottom || edge->low.y > top)
        return false;
    int a = edge->low.x, b = edge->high.x;
    line->edge = edge;
    line->from = 1;
    line->to = edge->longer - 1;
    if (edge->kind == STEEP) {
        line->from = MAX(1, bottom - edge->low.y);
        line->to = MIN(edge->longer - 1, top - edge->low.y);
        a = edge->low.x + edge->step * (int)(edge->slope * (uint32_t)line->from >> 16);
        b = edge->low.x + edge->step * (int)(edge->slope * (uint32_t)(line->to + 1) >> 16);
    }
    else if (edge->kind == SHALLOW) { /* its pixels lie at y and at y + 1 */
        int below = bottom - 1 - edge->low.y, above = top - edge->low.y;
        if (below > 0)
            line->from = (int)((((uint32_t)below << 16) + edge->slope - 1) / edge->slope);
        line->to = MIN(edge->longer - 1, (int)((((uint32_t)(above + 1) << 16) - 1) / edge->slope));
        a = edge->low.x + edge->step * (line->from - 1);
        b = edge->low.x + edge->step * line->to;
    }
    if (edge->kind == UPRIGHT || edge->kind == LEVEL) {
        *left = MIN(a, b);
        *right = MAX(a, b);
    }
    else {
        *left = MIN(a, b) - 1;
        *right = MAX(a, b) + 1;
    }
    int y = edge->first.y;
    if (y >= bottom && y <= top) {
        *left = MIN(*left, edge->first.x);
        *right = MAX(*right, edge->first.x);
    }
    *left = MAX(*left, 0);
    *right = MIN(*right, WIDTH - 1);
    return true;
}

/* The columns that all of the spans share, and those that any of them touches. */
static void bound(const Span *spans, int count, Span *all, Span *any)
{
    int i = 1;
    *all = *any = spans[0];
#ifdef __AVX2__
    if (count > 3) { /* four at a time, some of them twice */
        __m128i most = _mm_loadu_si128((const __m128i *)(spans + count - 4)), least = most;
        for (i = 0; i + 4 < count; i += 4) {
            __m128i four = _mm_loadu_si128((const __m128i *)(spans + i));
            most = _mm_max_epi16(most, four);
            least = _mm_min_epi16(least, four);
        }
        __m128i half = _mm_max_epi16(most, _mm_shuffle_epi32(most, _MM_SHUFFLE(1, 0, 3, 2)));
        most = _mm_max_epi16(half, _mm_shuffle_epi32(half, _MM_SHUFFLE(2, 3, 0, 1)));
        half = _mm_min_epi16(least, _mm_shuffle_epi32(least, _MM_SHUFFLE(1, 0, 3, 2)));
        least = _mm_min_epi16(half, _mm_shuffle_epi32(half, _MM_SHUFFLE(2, 3, 0, 1)));
        *all = (Span){(int16_t)_mm_extract_epi16(most, 0), (int16_t)_mm_extract_epi16(least, 1)};
        *any = (Span){(int16_t)_mm_extract_epi16(least, 0), (int16_t)_mm_extract_epi16(most, 1)};
        return;
    }
#endif
    for (; i < count; i++) {
        any->left = MIN(any->left, spans[i].left);
        any->right = MAX(any->right, spans[i].right);
        all->left = MAX(all->left, spans[i].left);
        all->right = MIN(all->right, spans[i].right);
    }
}

/* Finds which cells the shape dirties and which it covers. */
static void survey(Canvas *canvas, Band *band, int index)
{
    const Shape *shape = &canvas->shapes[index];
    const Axis *across = &canvas->across;
    for (int e = 0; e < shape->edges; e++) {
        Line *line = &band->lines[band->line_count];
        int left, right;
        if (!clip_edge(band, &shape->edge[e], line, &left, &right))
            continue;
        line->colour = shape->colour;
        line->low = across->low[left];
        line->high = across->high[right];
        soil(band, line->low, line->high);
        band->line_count++;
    }
    Patch *patch = &band->patches[band->patch_count++];
    patch->shape = shape;
    patch->lines_end = band->line_count;
    patch->top = MAX(shape->top, band->top);
    patch->bottom = MIN(shape->bottom, band->bottom);
    if (patch->top > patch->bottom)
        return;
    Span all, any;
    bound(shape->spans + patch->top - shape->top, patch->bottom - patch->top + 1, &all, &any);
    if (any.left > any.right) {
        patch->bottom = patch->top - 1;
        return;
    }
    patch->low = across->low[any.left];
    patch->high = across->high[any.right];
    soil(band, patch->low, patch->high);
    if (patch->top > band->top || patch->bottom < band->bottom || all.left > all.right)
        return;
    int low = across->after[all.left], high = across->before[all.right];
    if (low <= high)
        cover(band, low, high, shape->colour, index);
}

static int first_cell(Cells cells)
{
    return cells.left ? lowest_bit(cells.left) : cells.right ? 64 + lowest_bit(cells.right) : CELLS;
}

static Cells without(Cells cells, Cells others)
{
    return (Cells){cells.left & ~others.left, cells.right & ~others.right};
}

/* Source columns of the dirty ones among the cells. */
static void find_runs(const Canvas *canvas, Band *band)
{
    const Axis *across = &canvas->across;
    Cells rest = band->dirty, clean = {~rest.left, ~rest.right};
    band->run_count = 0;
    for (int low = first_cell(rest); low < CELLS; low = first_cell(rest)) {
        int high = first_cell(without(clean, cells_between(0, low - 1))) - 1;
        DirtyRun run = {across->first[low], across->last[high], band->base[low]};
        for (int j = low + 1; j <= high; j++)
            run.first = MIN(run.first, band->base[j]);
        band->runs[band->run_count++] = run;
        rest = without(rest, cells_between(low, high));
    }
}

/* Mostly short: stores that overlap are cheaper than a branch that nobody can foresee. */
static inline void paint(uint32_t *row, int left, int right, uint32_t colour)
{
    int count = right - left + 1;
    uint32_t *to = row + left;
#if defined(__AVX512F__)
    __m512i many = _mm512_set1_epi32((int)colour);
    for (; count > 32; count -= 32, to += 32) {
        _mm512_storeu_si512(to, many);
        _mm512_storeu_si512(to + 16, many);
    }
    uint32_t left_over = count > 0 ? ~(uint32_t)0 >> (32 - count) : 0;
    _mm512_mask_storeu_epi32(to, (__mmask16)left_over, many);
    _mm512_mask_storeu_epi32(to + 16, (__mmask16)(left_over >> 16), many);
    return;
#elif defined(__AVX2__)
    if (count > 7) {
        __m256i eight = _mm256_set1_epi32((int)colour);
        int last = count - 8;
        for (; last > 24; last -= 16, to += 16) {
            _mm256_storeu_si256((__m256i *)to, eight);
            _mm256_storeu_si256((__m256i *)(to + 8), eight);
        }
        _mm256_storeu_si256((__m256i *)to, eight);
        _mm256_storeu_si256((__m256i *)(to + MIN(last, 8)), eight);
        _mm256_storeu_si256((__m256i *)(to + MIN(last, 16)), eight);
        _mm256_storeu_si256((__m256i *)(to + last), eight);
        return;
    }
    if (count > 3) {
        __m128i four = _mm_set1_epi32((int)colour);
        _mm_storeu_si128((__m128i *)to, four);
        _mm_storeu_si128((__m128i *)(to + count - 4), four);
        return;
    }
#endif
    for (int i = 0; i < count; i++)
        to[i] = colour;
}

/* Two neighbouring pixels of an outline, which share its colour: d + ((c - d) * a >> 8) in each channel, which is
   (d * (256 - a) + c * a) >> 8. The alphas of the pair follow from one weight w: 255 * (255 - w) >> 8, which is 254 - w,
   and 255 * w >> 8, which is w - 1, neither below 0. */
typedef struct {
#ifdef __AVX2__
    __m256i wide;
    __m128i colour;
#else
    uint32_t colour;
#endif
} Ink;

#ifdef __AVX2__
static Ink ink_of(uint32_t colour)
{
    __m128i one = _mm_unpacklo_epi8(_mm_cvtsi32_si128((int)colour), _mm_setzero_si128());
    one = _mm_unpacklo_epi64(one, one);
    return (Ink){_mm256_broadcastsi128_si256(one), one};
}

static __m128i blend(__m128i under, Ink ink, uint32_t weight)
{
    __m128i w = _mm_shuffle_epi32(_mm_shufflelo_epi16(_mm_cvtsi32_si128((int)weight), 0), 0);
    __m128i alpha = _mm_unpacklo_epi64(_mm_subs_epu16(_mm_set1_epi16(254), w), _mm_subs_epu16(w, _mm_set1_epi16(1)));
    under = _mm_unpacklo_epi8(under, _mm_setzero_si128());
    __m128i sum = _mm_add_epi16(_mm_mullo_epi16(under, _mm_sub_epi16(_mm_set1_epi16(256), alpha)),
                                _mm_mullo_epi16(ink.colour, alpha));
    sum = _mm_srli_epi16(sum, 8);
    return _mm_packus_epi16(sum, sum);
}

static void dots(uint32_t *near, uint32_t *far, Ink ink, uint32_t weight)
{
    __m128i both = blend(_mm_unpacklo_epi32(_mm_cvtsi32_si128((int)*near), _mm_cvtsi32_si128((int)*far)), ink, weight);
    *near = (uint32_t)_mm_cvtsi128_si32(both);
    *far = (uint32_t)_mm_cvtsi128_si32(_mm_srli_si128(both, 4));
}

/* Both side by side, the left one with the weight's first alpha. */
static void dots_beside(uint32_t *left, Ink ink, uint32_t weight)
{
    _mm_storel_epi64((__m128i *)left, blend(_mm_loadl_epi64((const __m128i *)left), ink, weight));
}

/* Two such pairs; the weights are the second bytes of the first words of `at`'s halves. */
static __m128i blend_two(__m128i under, Ink ink, __m256i at, __m256i turn)
{
    __m256i second = _mm256_set1_epi16((short)0x8001);
    __m256i w = _mm256_xor_si256(_mm256_shuffle_epi8(at, second), turn);
    __m256i alpha = _mm256_unpacklo_epi64(_mm256_subs_epu16(_mm256_set1_epi16(254), w),
                                          _mm256_subs_epu16(w, _mm256_set1_epi16(1)));
    __m256i sum = _mm256_add_epi16(
        _mm256_mullo_epi16(_mm256_cvtepu8_epi16(under), _mm256_sub_epi16(_mm256_set1_epi16(256), alpha)),
        _mm256_mullo_epi16(ink.wide, alpha));
    sum = _mm256_srli_epi16(sum, 8);
    return _mm_packus_epi16(_mm256_castsi256_si128(sum), _mm256_extracti128_si256(sum, 1));
}

static __m256i two_weights(uint32_t at, uint32_t slope)
{
    return _mm256_inserti128_si256(_mm256_castsi128_si256(_mm_cvtsi32_si128((int)at)),
                                   _mm_cvtsi32_si128((int)(at + slope)), 1);
}
#else
static Ink ink_of(uint32_t colour)
{
    return (Ink){colour};
}

static uint32_t blend(uint32_t under, uint32_t over, uint32_t alpha)
{
    uint32_t rest = 256 - alpha;
    uint32_t outer = (under & 0xff00ff) * rest + (over & 0xff00ff) * alpha;
    uint32_t inner = (under >> 8 & 0xff) * rest + (over >> 8 & 0xff) * alpha;
    return (outer >> 8 & 0xff00ff) | (inner & 0xff00);
}

static void dots(uint32_t *near, uint32_t *far, Ink ink, uint32_t weight)
{
    *near = blend(*near, ink.colour, 255 * (255 - weight) >> 8);
    *far = blend(*far, ink.colour, 255 * weight >> 8);
}

static void dots_beside(uint32_t *left, Ink ink, uint32_t weight)
{
    dots(left, left + 1, ink, weight);
}
#endif

/* A step is a row: its two pixels lie side by side, the lighter one on either side. */
static void draw_steep(const Edge *edge, const Line *line, uint32_t *origin, Ink ink)
{
    uint32_t at = edge->slope * (uint32_t)line->from, turn = edge->step < 0 ? 255 : 0;
    uint32_t *row = origin + edge->low.x - (edge->step < 0) - (edge->low.y + line->from) * STRIDE;
    int n = line->from;
#ifdef __AVX2__
    __m256i weights = two_weights(at, edge->slope), more = _mm256_set1_epi32((int)(2 * edge->slope));
    __m256i turns = _mm256_set1_epi16((short)turn);
    for (; n < line->to; n += 2, at += 2 * edge->slope, row -= 2 * STRIDE) {
        __m128i *first = (__m128i *)(row + edge->step * (int)(at >> 16));
        __m128i *second = (__m128i *)(row - STRIDE + edge->step * (int)((at + edge->slope) >> 16));
        __m128i four = _mm_unpacklo_epi64(_mm_loadl_epi64(first), _mm_loadl_epi64(second));
        four = blend_two(four, ink, weights, turns);
        _mm_storel_epi64(first, four);
        _mm_storel_epi64(second, _mm_unpackhi_epi64(four, four));
        weights = _mm256_add_epi32(weights, more);
    }
#endif
    for (; n <= line->to; n++, at += edge->slope, row -= STRIDE)
        dots_beside(row + edge->step * (int)(at >> 16), ink, (at >> 8 & 255) ^ turn);
}

/* A step is a column: its two pixels lie above each other. */
static void draw_shallow(const Edge *edge, const Line *line, uint32_t *origin, Ink ink)
{
    uint32_t at = edge->slope * (uint32_t)line->from;
    uint32_t *column = origin + edge->low.x + edge->step * line->from - edge->low.y * STRIDE;
    int n = line->from;
#ifdef __AVX2__
    __m256i weights = two_weights(at, edge->slope), more = _mm256_set1_epi32((int)(2 * edge->slope));
    for (; n < line->to; n += 2, at += 2 * edge->slope, column += 2 * edge->step) {
        uint32_t *first = column - (int)(at >> 16) * STRIDE;
        uint32_t *second = column + edge->step - (int)((at + edge->slope) >> 16) * STRIDE;
        __m128i one = _mm_insert_epi32(_mm_cvtsi32_si128((int)*first), (int)*(first - STRIDE), 1);
        __m128i other = _mm_insert_epi32(_mm_cvtsi32_si128((int)*second), (int)*(second - STRIDE), 1);
        __m128i four = blend_two(_mm_unpacklo_epi64(one, other), ink, weights, _mm256_setzero_si256());
        *first = (uint32_t)_mm_cvtsi128_si32(four);
        *(first - STRIDE) = (uint32_t)_mm_extract_epi32(four, 1);
        *second = (uint32_t)_mm_extract_epi32(four, 2);
        *(second - STRIDE) = (uint32_t)_mm_extract_epi32(four, 3);
        weights = _mm256_add_epi32(weights, more);
    }
#endif
    for (; n <= line->to; n++, at += edge->slope, column += edge->step) {
        uint32_t *pixel = column - (int)(at >> 16) * STRIDE;
        dots(pixel, pixel - STRIDE, ink, at >> 8 & 255);
    }
}

static void draw_line(Canvas *canvas, const Band *band, const Line *line)
{
    const Edge *edge = line->edge;
    Point low = edge->low, first = edge->first;
    uint32_t colour = line->colour;
    /* of column 0 and y 0; a step of y upwards is a row less */
    uint32_t *origin = &canvas->band[0][MARGIN] + (HEIGHT - band->first) * STRIDE;
    if (edge->kind == LEVEL) {
        paint(origin - low.y * STRIDE, MIN(low.x, edge->high.x), MAX(low.x, edge->high.x), colour);
        return;
    }
    int bottom = HEIGHT - 1 - band->bottom, top = HEIGHT - 1 - band->top;
    if (edge->kind == UPRIGHT) {
        for (int y = MAX(low.y, bottom); y <= MIN(edge->high.y, top); y++)
            origin[low.x - y * STRIDE] = colour;
        return;
    }
    if (first.y >= bottom && first.y <= top)
        origin[first.x - first.y * STRIDE] = colour;
    if (edge->kind == STEEP)
        draw_steep(edge, line, origin, ink_of(colour));
    else
        draw_shallow(edge, line, origin, ink_of(colour));
}

#if defined(__AVX512F__)
enum { CHUNK = 32 /* pixels of two cache lines */ };

/* Paints columns `left` to `right` of `rows` rows, as far as they lie within the row's span. */
static void paint_spans(uint32_t *row, __m512i spans, int rows, int left, int right, uint32_t colour)
{
    __m512i many = _mm512_set1_epi32((int)colour), all = _mm512_set1_epi32(-1), none = _mm512_setzero_si512();
    __m512i from = _mm512_max_epi32(_mm512_srai_epi32(_mm512_slli_epi32(spans, 16), 16), _mm512_set1_epi32(left));
    __m512i to = _mm512_min_epi32(_mm512_srai_epi32(spans, 16), _mm512_set1_epi32(right));
    for (int x = left & -16; x <= right; x += CHUNK) {
        __m512i start = _mm512_max_epi32(_mm512_sub_epi32(from, _mm512_set1_epi32(x)), none);
        __m512i end = _mm512_max_epi32(_mm512_sub_epi32(to, _mm512_set1_epi32(x - 1)), none); /* beyond the last */
        uint32_t masks[16];
        _mm512_storeu_si512(masks, _mm512_andnot_si512(_mm512_sllv_epi32(all, end), _mm512_sllv_epi32(all, start)));
        uint32_t *pixels = row + x;
        if (right < x + 16)
            for (int i = 0; i < rows; i++, pixels += STRIDE)
                _mm512_mask_store_epi32(pixels, (__mmask16)masks[i], many);
        else
            for (int i = 0; i < rows; i++, pixels += STRIDE) {
                _mm512_mask_store_epi32(pixels, (__mmask16)masks[i], many);
                _mm512_mask_store_epi32(pixels + 16, (__mmask16)(masks[i] >> 16), many);
            }
    }
}

static __m512i spans_of(const Span *spans, int rows)
{
    return _mm512_maskz_loadu_epi32((__mmask16)((1u << rows) - 1), spans);
}
#endif

/* Paints columns `left` to `right` of some rows, as far as they lie within the spans. */
static void paint_rows(Canvas *canvas, const Band *band, int top, int bottom, const Span *spans, int left, int right,
                       uint32_t colour)
{
    uint32_t *row = canvas->band[top - band->first + 1] + MARGIN;
    int rows = bottom - top + 1;
#if defined(__AVX512F__)
    paint_spans(row, spans_of(spans, rows), rows, left, right, colour);
#else
    for (int i = 0; i < rows; i++, row += STRIDE)
        paint(row, MAX(spans[i].left, left), MIN(spans[i].right, right), colour);
#endif
}

/* Whole cache lines: what lies beside the run is clean, or nothing was painted there yet. */
static void paint_background(Canvas *canvas, const Band *band, DirtyRun run, uint32_t background)
{
    uint32_t *row = canvas->band[band->top - band->first + 1] + MARGIN;
    for (int y = band->top; y <= band->bottom; y++, row += STRIDE)
        for (int x = run.left & -16; x <= run.right; x += 16)
            for (int i = 0; i < 16; i++)
                row[x + i] = background;
}

static void draw_patch(Canvas *canvas, const Band *band, const Patch *patch)
{
    const Shape *shape = patch->shape;
    int index = (int)(shape - canvas->shapes);
    int left = canvas->across.first[patch->low], right = canvas->across.last[patch->high];
    for (int k = 0; k < band->run_count; k++) {
        DirtyRun run = band->runs[k];
        if (run.first > index || run.right < left)
            continue;
        if (run.left > right)
            break;
        paint_rows(canvas, band, patch->top, patch->bottom, shape->spans + patch->top - shape->top,
                   MAX(run.left, left), MIN(run.right, right), shape->colour);
    }
}

static bool any_dirty(const Band *band, int low, int high)
{
    Cells cells = cells_between(low, high);
    return (band->dirty.left & cells.left) || (band->dirty.right & cells.right);
}

/* The dirty cells of one row of cells, into the band. */
static void draw(Canvas *canvas, Band *band, uint32_t background)
{
    find_runs(canvas, band);
    for (int k = 0; k < band->run_count; k++)
        if (band->runs[k].first < 0)
            paint_background(canvas, band, band->runs[k], background);
    const Line *line = band->lines;
    for (const Patch *patch = band->patches; patch < band->patches + band->patch_count; patch++) {
        for (; line < band->lines + patch->lines_end; line++)
            if (any_dirty(band, line->low, line->high))
                draw_line(canvas, band, line);
        if (patch->top <= patch->bottom)
            draw_patch(canvas, band, patch);
    }
}

/* ---- averaging ---- */

#ifdef __AVX2__
static __m128i weigh(__m128i value, __m128i weight)
{
    return _mm_mulhi_epu16(_mm_slli_epi16(value, 2), weight);
}

static __m256i weigh_two(__m256i value, const uint16_t *weights)
{
    __m128i once = _mm_loadu_si128((const __m128i *)weights);
    return _mm256_mulhi_epu16(_mm256_slli_epi16(value, 2), _mm256_broadcastsi128_si256(once));
}

/* The sums of the even and the odd ones of a cell's pixels, four 16-bit channels each, of two rows. The first pixel and
   the last ones have weights. */
static __m256i add_up(const uint32_t *a, const uint32_t *b, const uint16_t *weights)
{
    __m256i zero = _mm256_setzero_si256(), sum = zero;
    for (int x = 0; x < CELL; x += 4) {
        __m256i four = _mm256_inserti128_si256(_mm256_castsi128_si256(_mm_loadu_si128((const __m128i *)(a + x))),
                                               _mm_loadu_si128((const __m128i *)(b + x)), 1);
        __m256i low = _mm256_unpacklo_epi8(four, zero), high = _mm256_unpackhi_epi8(four, zero);
        if (x == 0)
            low = weigh_two(low, weights);
        if (x == CELL - 4)
            high = weigh_two(high, weights + 8);
        sum = _mm256_add_epi16(sum, _mm256_add_epi16(low, high));
    }
    return sum;
}

/* The averages along cell j of two source rows, side by side. */
static __m128i average_rows(const Axis *across, const uint32_t *a, const uint32_t *b, int j)
{
    int x = MARGIN + across->first[j];
    __m256i both = add_up(a + x, b + x, across->ends[j]);
    __m128i one = _mm256_castsi256_si128(both), other = _mm256_extracti128_si256(both, 1);
    __m128i sum = _mm_add_epi16(_mm_unpacklo_epi64(one, other), _mm_unpackhi_epi64(one, other));
    return _mm_mulhi_epu16(sum, _mm_set1_epi16((short)across->reciprocal));
}

static uint32_t average(const Canvas *canvas, int i, int j)
{
    static const uint32_t nothing[STRIDE];
    const Axis *across = &canvas->across, *down = &canvas->down;
    int row = 1, last = 1 + down->last[i] - down->first[i];
    const uint32_t *first = nothing;
    int first_weight = 0;
    if (i > 0) {
        first = canvas->band[row++];
        first_weight = down->first_weight[i];
    }
    __m128i weights = _mm_unpacklo_epi64(_mm_set1_epi16((short)first_weight),
                                         _mm_set1_epi16((short)down->last_weight[i]));
    __m128i sum = weigh(average_rows(across, first, canvas->band[last], j), weights);
    for (; row < last; row += 2)
        sum = _mm_add_epi16(sum, average_rows(across, canvas->band[row],
                                              row + 1 < last ? canvas->band[row + 1] : nothing, j));
    sum = _mm_add_epi16(sum, _mm_unpackhi_epi64(sum, sum));
    sum = _mm_mulhi_epu16(sum, _mm_set1_epi16((short)down->reciprocal));
    return (uint32_t)_mm_cvtsi128_si32(_mm_packus_epi16(sum, sum));
}
#else
static uint16_t part(uint32_t value, uint32_t weight)
{
    return (uint16_t)((uint16_t)(value << 2) * weight >> 16);
}

static uint32_t average_row(const Axis *across, const uint32_t *row, int j, int shift)
{
    int first = across->first[j], last = across->last[j];
    uint32_t sum = 0;
    row += MARGIN;
    if (j > 0)
        sum = part(CHANNEL(row[first++], shift), across->first_weight[j]);
    for (; first < last; first++)
        sum += CHANNEL(row[first], shift);
    sum += part(CHANNEL(row[last], shift), across->last_weight[j]);
    return (sum & 0xffff) * across->reciprocal >> 16;
}

static uint32_t average(const Canvas *canvas, int i, int j)
{
    const Axis *across = &canvas->across, *down = &canvas->down;
    uint32_t cell = 0;
    for (int shift = 0; shift < 24; shift += 8) {
        int row = 1, last = 1 + down->last[i] - down->first[i];
        uint32_t sum = 0;
        if (i > 0)
            sum = part(average_row(across, canvas->band[row++], j, shift), down->first_weight[i]);
        for (; row < last; row++)
            sum += average_row(across, canvas->band[row], j, shift);
        sum += part(average_row(across, canvas->band[last], j, shift), down->last_weight[i]);
        cell |= MIN(255u, (sum & 0xffff) * down->reciprocal >> 16) << shift;
    }
    return cell;
}
#endif

/* Begins with the row's source rows that lie in the window, all background. */
static void begin_band(const Canvas *canvas, Band *band, int i, const uint8_t *blank, uint8_t *out)
{
    band->first = canvas->down.first[i];
    band->top = MAX(band->first, canvas->top);
    band->bottom = MIN(canvas->down.last[i], canvas->bottom);
    band->patch_count = band->line_count = 0;
    band->out = out;
    band->dirty = (Cells){0, 0};
    memset(band->base, 0xff, sizeof band->base); /* -1 */
    memcpy(out, blank, 3 * CELLS);
}

void band_finish(Canvas *canvas, uint32_t background, int from, int to, uint8_t *out)
{
    static Band band; /* as the canvas, one a process */
    uint8_t blank[3 * CELLS];
    for (int x = 0; x < 3 * CELLS; x++)
        blank[x] = finished(background, 16 - x % 3 * 8);
    for (int i = from; i < to; i++, out += 3 * CELLS) {
        begin_band(canvas, &band, i, blank, out);
        for (int word = 0; word * 64 < canvas->count; word++)
            for (uint64_t rest = canvas->active[word][i]; rest; rest &= rest - 1)
                survey(canvas, &band, word * 64 + lowest_bit(rest));
        draw(canvas, &band, background);
        Cells dirty = band.dirty;
        for (int j = first_cell(dirty); j < CELLS; j = first_cell(dirty)) {
            uint32_t cell = average(canvas, i, j);
            for (int c = 0; c < 3; c++)
                out[3 * j + c] = (uint8_t)CHANNEL(cell, 16 - 8 * c);
            dirty = without(dirty, cells_between(j, j));
        }
    }
}
