/* band.c and box.c for processors with AVX2. They compute with whole numbers only, so they draw the same bits. */

#include "canvas.h"

#ifdef DREAMFLEET_WIDE
#pragma GCC target("avx2")
#define band_finish band_finish_avx2
#include "band.c"
#define box_shrink box_shrink_avx2
#include "box.c"
#endif
