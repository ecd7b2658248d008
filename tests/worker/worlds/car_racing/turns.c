/* Compares turn.c with this host's library: one of so many floats of all, and as many doubles as these are floats.
   Prints how many differ, and how many arc tangents differ by more than the last digit. */

#include "plane.h"

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static int differs(double ours, double theirs)
{
    return memcmp(&ours, &theirs, sizeof ours) != 0;
}

int main(int count, char **words)
{
    uint64_t stride = count > 1 ? strtoull(words[1], NULL, 10) : 1, differ = 0, far = 0;
    turn_init();
    for (uint64_t at = 0; at < UINT64_C(1) << 32; at += stride) {
        uint32_t bits = (uint32_t)at;
        float angle;
        memcpy(&angle, &bits, sizeof angle);
        Turn ours = turn_by(angle), theirs = {sinf(angle), cosf(angle)};
        differ += isfinite(angle) ? memcmp(&ours, &theirs, sizeof ours) != 0 : !isnan(ours.sine) || !isnan(ours.cosine);
        double wide = ((double)at - 0x1p31) * (at % 3 ? 0x1.6p-28 : 0x1.7p-6); /* of +-11 and of +-50 million */
        differ += differs(turn_sine(wide), sin(wide)) + differs(turn_cosine(wide), cos(wide));
        double x = cos(wide) * 200, y = sin(wide) * (double)(at % 999), theirs_too = atan2(y, x);
        far += fabs(turn_towards(y, x) - theirs_too) > fabs(theirs_too) * 0x1p-52;
    }
    differ += turn_towards(0, 0) != 0;
    printf("%llu %llu\n", (unsigned long long)differ, (unsigned long long)far);
    return 0;
}
