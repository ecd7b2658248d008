/* band.c for processors with AVX2. It computes with whole numbers only, so it draws the same bits. */

#include "canvas.h"

#ifdef DREAMFLEET_AVX2
#pragma GCC target("avx2")
#define band_finish band_finish_avx2
#include "band.c"
#endif
