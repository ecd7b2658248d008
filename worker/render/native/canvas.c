/* From shapes to pixels: draws inside dirty cells only, then averages each cell as pygame's smoothscale does. */

#include "canvas.h"

#include <string.h>
#ifdef __SSE2__
#include <emmintrin.h>
#endif

#define MIN(a, b) ((a) < (b) ? (a) : (b))
#define MAX(a, b) ((a) > (b) ? (a) : (b))

enum { ONE = 1 << 14 }; /* a whole source pixel's weight */

/* ---- which source pixels a cell averages ---- */

static uint16_t part(uint32_t value, uint32_t weight)
{
    return (uint16_t)((uint16_t)(value << 2) * weight >> 16);
}

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
        for (int pixel = axis->first[j]; pixel <= axis->last[j]; pixel++) {
            if (axis->low[pixel] == 0xff)
                axis->low[pixel] = (uint8_t)j;
            axis->high[pixel] = (uint8_t)j;
        }
        for (uint32_t value = 0; value < 256; value++) {
            int whole = axis->last[j] - axis->first[j] - (j > 0);
            uint32_t sum = (j > 0 ? part(value, axis->first_weight[j]) : 0u) + (uint32_t)whole * value +
                           part(value, axis->last_weight[j]);
            axis->plain[j][value] = (uint8_t)MIN(255u, sum * axis->reciprocal >> 16);
        }
    }
    for (int pixel = axis->last[CELLS - 1] + 1; pixel < length; pixel++)
        axis->low[pixel] = axis->high[pixel] = CELLS - 1; /* no cell takes it; harmless to draw */
}

void canvas_init(Canvas *canvas)
{
    axis_init(&canvas->across, WIDTH);
    axis_init(&canvas->down, HEIGHT);
    memset(canvas->middle, 0xff, sizeof canvas->middle);
    for (int i = 0; i < CELLS; i++)
        canvas->middle[(canvas->down.first[i] + canvas->down.last[i]) / 2] = (int16_t)i;
    /* The bar's first row takes a sliver of the scene's last source row, which rounds to nothing. */
    for (int pixel = SCENE; pixel < HEIGHT; pixel++)
        if (canvas->down.low[pixel] < SCENE_ROWS)
            canvas->down.low[pixel] = SCENE_ROWS;
    for (int pixel = 0; pixel < SCENE; pixel++)
        if (canvas->down.high[pixel] >= SCENE_ROWS)
            canvas->down.high[pixel] = SCENE_ROWS - 1;
}

void canvas_begin(Canvas *canvas, uint32_t background)
{
    canvas->count = 0;
    canvas->overflow = false;
    memset(canvas->head, 0xff, sizeof canvas->head);
    memset(canvas->tail, 0xff, sizeof canvas->tail);
    memset(canvas->dirty, 0, sizeof canvas->dirty);
    for (int i = 0; i < CELLS; i++)
        for (int j = 0; j < CELLS; j++)
            canvas->colour[i][j] = background;
}

/* ---- drawing where it is noticed ---- */

typedef struct {
    Run runs[MAX_RUNS];
    int count;
} Runs;

/* Source columns of the dirty ones among a row of cells. */
static void find_runs(const Canvas *canvas, const uint8_t *dirty, Runs *out)
{
    const Axis *across = &canvas->across;
    out->count = 0;
    for (int j = 0; j < CELLS; j++) {
        if (j % 8 == 0) { /* mostly nothing: look at eight at once */
            uint64_t some;
            memcpy(&some, dirty + j, sizeof some);
            if (!some) {
                j += 7;
                continue;
            }
        }
        if (!dirty[j])
            continue;
        int start = j;
        while (j + 1 < CELLS && dirty[j + 1])
            j++;
        Run run = {(int16_t)across->first[start], (int16_t)across->last[j]};
        if (out->count && run.left <= out->runs[out->count - 1].right)
            out->runs[out->count - 1].right = run.right;
        else
            out->runs[out->count++] = run;
    }
}

static void paint(uint32_t *row, int left, int right, uint32_t colour)
{
    for (int x = left; x <= right; x++)
        row[x] = colour;
}

/* d + ((c - d) * a >> 8) in each channel, which is (d * (256 - a) + c * a) >> 8; two channels at once. */
static uint32_t blend(uint32_t under, uint32_t over, uint32_t alpha)
{
    uint32_t rest = 256 - alpha;
    uint32_t outer = (under & 0xff00ff) * rest + (over & 0xff00ff) * alpha;
    uint32_t inner = (under >> 8 & 0xff) * rest + (over >> 8 & 0xff) * alpha;
    return (outer >> 8 & 0xff00ff) | (inner & 0xff00);
}

/* The dirty cells of one row of cells, into the band. */
static void draw(Canvas *canvas, uint32_t background, int i)
{
    const Axis *down = &canvas->down;
    Runs dirty;
    find_runs(canvas, canvas->dirty[i], &dirty);
    for (int row = down->first[i]; row <= down->last[i]; row++) {
        uint32_t *pixels = canvas->band[row - down->first[i]];
        for (int k = 0; k < dirty.count; k++)
            paint(pixels, dirty.runs[k].left, dirty.runs[k].right, background);
        for (int32_t index = canvas->head[row]; index >= 0; index = canvas->ops[index].next) {
            Op op = canvas->ops[index];
            if (op.alpha == FILL)
                for (int k = 0; k < dirty.count && dirty.runs[k].left <= op.right; k++)
                    paint(pixels, MAX(op.left, dirty.runs[k].left), MIN(op.right, dirty.runs[k].right), op.colour);
            else if (op.alpha == 255)
                paint(pixels, op.left, op.right, op.colour);
            else
                pixels[op.left] = blend(pixels[op.left], op.colour, op.alpha);
        }
    }
}

/* ---- averaging ---- */

typedef struct {
    uint8_t channel[4]; /* blue, green, red, nothing: as the pixel lies in memory */
} Small;

#ifdef __SSE2__
static __m128i widen(const uint32_t *pixel)
{
    return _mm_unpacklo_epi8(_mm_cvtsi32_si128((int)*pixel), _mm_setzero_si128());
}

static __m128i weigh(__m128i value, int weight)
{
    return _mm_mulhi_epu16(_mm_slli_epi16(value, 2), _mm_set1_epi16((short)weight));
}

/* The average of one row of a cell. */
static __m128i average_row(const Axis *across, const uint32_t *row, int j)
{
    const uint32_t *pixel = row + across->first[j], *last = row + across->last[j];
    __m128i sum = _mm_setzero_si128(), zero = sum;
    if (j > 0)
        sum = weigh(widen(pixel++), across->first_weight[j]);
    for (; pixel + 4 <= last; pixel += 4) {
        __m128i four = _mm_loadu_si128((const __m128i *)pixel);
        __m128i pairs = _mm_add_epi16(_mm_unpacklo_epi8(four, zero), _mm_unpackhi_epi8(four, zero));
        sum = _mm_add_epi16(sum, _mm_add_epi16(pairs, _mm_srli_si128(pairs, 8)));
    }
    for (; pixel < last; pixel++)
        sum = _mm_add_epi16(sum, widen(pixel));
    sum = _mm_add_epi16(sum, weigh(widen(last), across->last_weight[j]));
    return _mm_mulhi_epu16(sum, _mm_set1_epi16((short)across->reciprocal));
}

static Small average(const Canvas *canvas, int i, int j)
{
    const Axis *down = &canvas->down;
    int row = 0, last = down->last[i] - down->first[i];
    __m128i sum = _mm_setzero_si128();
    if (i == SCENE_ROWS)
        row++; /* the sliver of the scene, see canvas_init */
    else if (i > 0)
        sum = weigh(average_row(&canvas->across, canvas->band[row++], j), down->first_weight[i]);
    for (; row < last; row++)
        sum = _mm_add_epi16(sum, average_row(&canvas->across, canvas->band[row], j));
    sum = _mm_add_epi16(sum, weigh(average_row(&canvas->across, canvas->band[last], j), down->last_weight[i]));
    sum = _mm_mulhi_epu16(sum, _mm_set1_epi16((short)down->reciprocal));
    int packed = _mm_cvtsi128_si32(_mm_packus_epi16(sum, sum));
    Small small;
    memcpy(&small, &packed, sizeof small);
    return small;
}
#else
static uint32_t average_row(const Axis *across, const uint32_t *row, int j, int shift)
{
    int first = across->first[j], last = across->last[j];
    uint32_t sum = 0;
    if (j > 0)
        sum = part(row[first++] >> shift & 255, across->first_weight[j]);
    for (; first < last; first++)
        sum += row[first] >> shift & 255;
    sum += part(row[last] >> shift & 255, across->last_weight[j]);
    return MIN(255u, (sum & 0xffff) * across->reciprocal >> 16);
}

static Small average(const Canvas *canvas, int i, int j)
{
    const Axis *down = &canvas->down;
    Small small = {{0, 0, 0, 0}};
    for (int c = 0; c < 3; c++) {
        int row = 0, last = down->last[i] - down->first[i];
        uint32_t sum = 0;
        if (i == SCENE_ROWS)
            row++;
        else if (i > 0)
            sum = part(average_row(&canvas->across, canvas->band[row++], j, 8 * c), down->first_weight[i]);
        for (; row < last; row++)
            sum += average_row(&canvas->across, canvas->band[row], j, 8 * c);
        sum += part(average_row(&canvas->across, canvas->band[last], j, 8 * c), down->last_weight[i]);
        small.channel[c] = (uint8_t)MIN(255u, (sum & 0xffff) * down->reciprocal >> 16);
    }
    return small;
}
#endif

void canvas_finish(Canvas *canvas, uint32_t background, int from, int to, uint8_t *out)
{
    for (int i = from; i < to; i++) {
        draw(canvas, background, i);
        const uint8_t *down = canvas->down.plain[i];
        for (int j = 0; j < CELLS; j++, out += 3) {
            if (canvas->dirty[i][j]) {
                Small small = average(canvas, i, j);
                out[0] = small.channel[2];
                out[1] = small.channel[1];
                out[2] = small.channel[0];
                continue;
            }
            const uint8_t *across = canvas->across.plain[j];
            uint32_t colour = canvas->colour[i][j];
            out[0] = down[across[colour >> 16 & 255]];
            out[1] = down[across[colour >> 8 & 255]];
            out[2] = down[across[colour & 255]];
        }
    }
}
