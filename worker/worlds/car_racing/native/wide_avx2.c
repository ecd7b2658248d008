/* band.c, box.c and fill.c for processors with AVX2. No instruction of theirs rounds in another way, so they draw
   the same bits. */

#include "canvas.h"

#ifdef DREAMFLEET_WIDE
#pragma GCC target("avx2")
#define band_finish band_finish_avx2
#include "band.c"
#define box_shrink box_shrink_avx2
#include "box.c"
#define fill_spans fill_spans_avx2
#include "fill.c"
#endif
