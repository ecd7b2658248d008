/* Sine and cosine in single precision, with the results of glibc's `sinf` and `cosf` on x86-64 with fused products.

   glibc itself gives other bits for a few angles on processors without them, and other libraries do for more. The method
   and its numbers are those of Arm's optimized routines: a quarter turn's remainder and two polynomials, in double
   precision. `fma` stands where GCC fuses in glibc's build. */

#include "plane.h"

#include <stdint.h>
#include <string.h>

static const double HALF_PI = 0x1.921fb54442d18p0;

/* The remainder of an angle of less than 120, and how many quarters were taken away. */
static double reduce(double angle, unsigned *quarters)
{
    int32_t whole = ((int32_t)(angle * 0x1.45f306dc9c883p+23) + 0x800000) >> 24;
    *quarters = (unsigned)whole;
    return fma(-(double)whole, HALF_PI, angle);
}

/* The same of a larger one, without its sign, by the digits of 4/pi that its exponent asks for. */
static double reduce_large(uint32_t bits, unsigned *quarters)
{
    static const uint32_t DIGITS[] = {0xa2,       0xa2f9,     0xa2f983,   0xa2f9836e, 0xf9836e4e, 0x836e4e44,
                                      0x6e4e4415, 0x4e441529, 0x441529fc, 0x1529fc27, 0x29fc2757, 0xfc2757d1,
                                      0x2757d1f5, 0x57d1f534, 0xd1f534dd, 0xf534ddc0, 0x34ddc0db, 0xddc0db62,
                                      0xc0db6295, 0xdb629599, 0x6295993c, 0x95993c43, 0x993c4390, 0x3c439041};
    const uint32_t *digits = &DIGITS[bits >> 26 & 15];
    uint32_t factor = ((bits & 0xffffff) | 0x800000) << (bits >> 23 & 7);
    uint64_t product = (uint64_t)(factor * digits[0]) << 32 | (uint64_t)factor * digits[8] >> 32;
    product += (uint64_t)factor * digits[4];
    uint64_t whole = (product + ((uint64_t)1 << 61)) >> 62;
    *quarters = (unsigned)whole;
    return (double)(int64_t)(product - (whole << 62)) * 0x1.921fb54442d18p-62;
}

static float sine_near_0(double x, double square)
{
    double cube = x * square, more = fma(square, -0x1.994eb3774cf24p-13, 0x1.1107605230bc4p-7);
    return (float)fma(cube * square, more, fma(cube, -0x1.555545995a603p-3, x));
}

static float cosine_near_0(double square)
{
    double fourth = square * square, more = fma(square, 0x1.99343027bf8c3p-16, -0x1.6c087e89a359dp-10);
    double first = fma(square, -0x1.ffffffd0c621cp-2, 1);
    return (float)fma(fourth * square, more, fma(fourth, 0x1.55553e1068f19p-5, first));
}

/* The upper bits of a number without its sign. */
static uint32_t top(float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits >> 20 & 0x7ff;
}

Turn turn_by(float angle)
{
    double x = angle;
    unsigned quarters = 0;
    if (top(angle) < top(0x1p-12f))
        return (Turn){angle, 1};
    if (top(angle) >= top(INFINITY))
        return (Turn){angle - angle, angle - angle};
    if (top(angle) >= top(120.0f)) {
        uint32_t bits;
        memcpy(&bits, &angle, sizeof bits);
        x = reduce_large(bits & 0x7fffffff, &quarters);
        if (angle < 0) {
            x = -x;
            quarters = 0 - quarters;
        }
    }
    else if (top(angle) >= top((float)(HALF_PI / 2)))
        x = reduce(x, &quarters);
    float sine = sine_near_0(x, x * x), cosine = cosine_near_0(x * x);
    switch (quarters & 3) {
    case 0:
        return (Turn){sine, cosine};
    case 1:
        return (Turn){cosine, -sine};
    case 2:
        return (Turn){-sine, -cosine};
    default:
        return (Turn){-cosine, sine};
    }
}
