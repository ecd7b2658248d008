/* band.c and box.c for processors with AVX-512. They compute with whole numbers only, so they draw the same bits. */

#include "canvas.h"

#ifdef DREAMFLEET_WIDE
#pragma GCC target("avx2,bmi,bmi2,lzcnt,avx512f,avx512bw,avx512vl,avx512dq")
#define band_finish band_finish_avx512
#include "band.c"
#define box_shrink box_shrink_avx512
#include "box.c"
#endif
