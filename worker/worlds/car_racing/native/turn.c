/* Sine, cosine and arc tangent, the same on every host: glibc itself gives other bits for a few angles on processors
   without fused products, and other libraries do for more. `fma` stands where GCC fuses in glibc's build for x86-64. */

#include "plane.h"

#include <stdint.h>
#include <string.h>

static const double HALF_PI = 0x1.921fb54442d18p0, HALF_PI_REST = 0x1.1a62633145c07p-54;

/* ---- in single precision: glibc's `sinf` and `cosf`, by the method and the numbers of Arm's optimized routines: a
   quarter turn's remainder and two polynomials, in double precision ---- */

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

/* ---- in double precision: glibc's `sin` and `cos`, by its method: from the nearest multiple of 1/128 ---- */

/* A number that no double is: the nearest one, and what it lacks. */
typedef struct {
    double near, rest;
} Long;

/* The first part must not be the smaller one, here and in `plus`. */
static Long long_of(double near, double rest)
{
    double sum = near + rest;
    return (Long){sum, rest - (sum - near)};
}

static Long plus(Long a, Long b)
{
    Long sum = long_of(a.near, b.near);
    return long_of(sum.near, sum.rest + (a.rest + b.rest));
}

static Long times(Long a, Long b)
{
    double near = a.near * b.near;
    return long_of(near, fma(a.near, b.near, -near) + (a.near * b.rest + a.rest * b.near));
}

static Long minus(Long a)
{
    return (Long){-a.near, -a.rest};
}

/* Taylor's series of the sine, from the angle and 2 on, or of the cosine, from 1 and 1 on. */
static Long series(double angle, Long term, int from, int terms)
{
    Long sum = term, square = times((Long){angle, 0}, (Long){angle, 0});
    for (int n = from; n < from + 2 * terms; n += 2) {
        Long more = times(term, square);
        double divisor = -n * (n + 1.0), near = more.near / divisor;
        term = long_of(near, (fma(-near, divisor, more.near) + more.rest) / divisor);
        sum = plus(sum, term);
    }
    return sum;
}

enum { PLACES = 111 };
static struct {
    Long sine, cosine;
} places[PLACES]; /* of 0, 1/128, 2/128 and so on */

void turn_init(void)
{
    for (int i = 0; i < PLACES; i++) {
        places[i].sine = series(i / 128.0, (Long){i / 128.0, 0}, 2, 15);
        places[i].cosine = series(i / 128.0, (Long){1, 0}, 1, 15);
    }
}

static double rise(double x, double square, double rest)
{
    return fma(x * square, fma(square, 0x1.11110e829872fp-7, -0x1.5555555555515p-3), rest);
}

static double fall(double square)
{
    return square * fma(square, fma(square, 0x1.6c16bedd9e239p-10, -0x1.5555555555535p-5), 0.5);
}

/* The multiple of 1/128 next to a number that is not negative. */
static int place_of(double x)
{
    return (int)((x + 0x1.8p45 - 0x1.8p45) * 128);
}

/* Of x + rest, which lies within an eighth of a turn, or a little more. */
static double sine_within(double x, double rest)
{
    double square = x * x, near = fabs(x);
    if (near < 0.126) {
        double more = fma(square, -0x1.addffc2fcdf59p-26, 0x1.71de27b9a7ed9p-19);
        more = fma(fma(square, more, -0x1.a01a019db08b8p-13), square, 0x1.1111111110ecep-7);
        return x + fma(fma(fma(more, square, -0x1.5555555555555p-3), x, -0.5 * rest), square, rest);
    }
    int place = place_of(near);
    Long sine = places[place].sine, cosine = places[place].cosine;
    rest = x > 0 ? rest : -rest;
    near -= place / 128.0;
    square = near * near;
    double up = near + rise(near, square, rest), down = fma(near, rest, fall(square));
    double more = fma(cosine.near, up, fma(-sine.near, down, fma(up, cosine.rest, sine.rest)));
    return copysign(sine.near + more, x);
}

static double cosine_within(double x, double rest)
{
    int place = place_of(fabs(x));
    Long sine = places[place].sine, cosine = places[place].cosine;
    double near = fabs(x) - place / 128.0 + (x < 0 ? -rest : rest), square = near * near;
    double up = rise(near, square, near), down = fall(square);
    return cosine.near + fma(-sine.near, up, fma(-cosine.near, down, fma(-up, sine.rest, cosine.rest)));
}

/* The sine of an angle and so many quarters more. */
static double sine_after(double angle, int more)
{
    double whole = fma(angle, 0x1.45f306dc9c883p-1, 0x1.8p52) - 0x1.8p52;
    double first = fma(-whole, -0x1.dde973cp-27, fma(-whole, 0x1.921fb58p0, angle));
    double second = fma(-whole, -0x1.cb3b398p-55, first), near = fma(-whole, -0x1.d747f23e32ed7p-83, second);
    double rest = fma(-whole, -0x1.d747f23e32ed7p-83, second - near) + fma(-whole, -0x1.cb3b398p-55, first - second);
    int quarters = (int)whole + more;
    double sine = quarters & 1 ? cosine_within(near, rest) : sine_within(near, rest);
    return quarters & 2 ? -sine : sine;
}

static const double SMALL = 0x1.b6p-1, MIDDLE = 0x1.368fdp1, LARGE = 0x1.921fbp26;

double turn_sine(double angle)
{
    double size = fabs(angle);
    if (size < SMALL)
        return sine_within(angle, 0);
    if (size < MIDDLE)
        return copysign(cosine_within(HALF_PI - size, HALF_PI_REST), angle);
    return size < LARGE ? sine_after(angle, 0) : sin(angle); /* which no wheel reaches in a day */
}

double turn_cosine(double angle)
{
    double size = fabs(angle), left = HALF_PI - size, near = left + HALF_PI_REST;
    if (size < SMALL)
        return cosine_within(angle, 0);
    if (size < MIDDLE)
        return sine_within(near, left - near + HALF_PI_REST);
    return size < LARGE ? sine_after(angle, 1) : cos(angle);
}

/* A host's arc tangent, mended until it rounds correctly, which glibc's does but for one in a thousand. */
double turn_towards(double y, double x)
{
    double across = fabs(y) < fabs(x) ? fabs(y) : fabs(x), along = fabs(y) < fabs(x) ? fabs(x) : fabs(y);
    if (!(along > 0))
        return 0;
    double guess = atan(across / along), beyond;
    int place = place_of(guess);
    Long sine = places[place].sine, cosine = places[place].cosine;
    beyond = guess - place / 128.0;
    Long up = series(beyond, (Long){beyond, 0}, 2, 5), down = series(beyond, (Long){1, 0}, 1, 5);
    Long high = plus(times(sine, down), times(cosine, up)), wide = plus(times(cosine, down), minus(times(sine, up)));
    Long error = plus(times((Long){along, 0}, high), minus(times((Long){across, 0}, wide)));
    Long angle = long_of(guess, -(error.near + error.rest) / (along * wide.near + across * high.near));
    if (fabs(y) >= fabs(x))
        angle = plus((Long){HALF_PI, HALF_PI_REST}, minus(angle));
    if (x < 0)
        angle = plus((Long){2 * HALF_PI, 2 * HALF_PI_REST}, minus(angle));
    return copysign(angle.near, y);
}
