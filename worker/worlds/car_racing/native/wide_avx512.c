/* band.c, box.c and fill.c for processors with AVX-512. No instruction of theirs rounds in another way, so they draw
   the same bits. */

#include "canvas.h"

#ifdef DREAMFLEET_WIDE
#pragma GCC target("avx2,bmi,bmi2,lzcnt,avx512f,avx512bw,avx512vl,avx512dq")
#define band_finish band_finish_avx512
#include "band.c"
#define box_shrink box_shrink_avx512
#include "box.c"
#define fill_spans fill_spans_avx512
#include "fill.c"
#endif
