/* Compares turn_by with this host's sinf and cosf: one of so many floats of all. Prints the number that differ. */

#include "plane.h"

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

int main(int count, char **words)
{
    uint64_t stride = count > 1 ? strtoull(words[1], NULL, 10) : 1, differ = 0;
    for (uint64_t at = 0; at < UINT64_C(1) << 32; at += stride) {
        uint32_t bits = (uint32_t)at;
        float angle;
        memcpy(&angle, &bits, sizeof angle);
        Turn ours = turn_by(angle), theirs = {sinf(angle), cosf(angle)};
        differ += isfinite(angle) ? memcmp(&ours, &theirs, sizeof ours) != 0 : !isnan(ours.sine) || !isnan(ours.cosine);
    }
    printf("%llu\n", (unsigned long long)differ);
    return 0;
}
