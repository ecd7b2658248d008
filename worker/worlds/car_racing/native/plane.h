/* Points, turns and boxes of the plane, in single precision. Every operation rounds once and in the order in which it
   is written: the car must come to the same bits as Box2D 2.3 gives it, so no sum may be arranged otherwise. */
#ifndef DREAMFLEET_PLANE_H
#define DREAMFLEET_PLANE_H

#include <math.h>
#include <stdbool.h>

typedef struct {
    float x, y;
} Vec;

typedef struct {
    float sine, cosine;
} Turn;

/* Where a body's origin is, and how it is turned. */
typedef struct {
    Vec at;
    Turn turn;
} Pose;

typedef struct {
    Vec low, high;
} Box;

static inline Vec vec_add(Vec a, Vec b)
{
    return (Vec){a.x + b.x, a.y + b.y};
}

static inline Vec vec_sub(Vec a, Vec b)
{
    return (Vec){a.x - b.x, a.y - b.y};
}

static inline Vec vec_scale(float factor, Vec a)
{
    return (Vec){factor * a.x, factor * a.y};
}

static inline float vec_dot(Vec a, Vec b)
{
    return a.x * b.x + a.y * b.y;
}

static inline float vec_cross(Vec a, Vec b)
{
    return a.x * b.y - a.y * b.x;
}

static inline float vec_length(Vec a)
{
    return sqrtf(vec_dot(a, a));
}

/* ---- of turn.c: the same on every host ---- */

/* Before any of those in double precision. */
void turn_init(void);

Turn turn_by(float angle);
double turn_sine(double angle);
double turn_cosine(double angle);

/* The angle of (x, y). */
double turn_towards(double y, double x);

static inline Vec turn_out(Turn turn, Vec local)
{
    return (Vec){turn.cosine * local.x - turn.sine * local.y, turn.sine * local.x + turn.cosine * local.y};
}

/* Back into the turned frame. */
static inline Vec turn_in(Turn turn, Vec world)
{
    return (Vec){turn.cosine * world.x + turn.sine * world.y, -turn.sine * world.x + turn.cosine * world.y};
}

static inline Vec pose_out(Pose pose, Vec local)
{
    return vec_add(turn_out(pose.turn, local), pose.at);
}

static inline float smaller(float a, float b)
{
    return a < b ? a : b;
}

static inline float larger(float a, float b)
{
    return a > b ? a : b;
}

static inline float clamp(float value, float low, float high)
{
    return larger(low, smaller(value, high));
}

static inline double sign(double value)
{
    return (value > 0) - (value < 0);
}

static inline Box box_join(Box a, Box b)
{
    return (Box){{smaller(a.low.x, b.low.x), smaller(a.low.y, b.low.y)},
                 {larger(a.high.x, b.high.x), larger(a.high.y, b.high.y)}};
}

static inline bool box_holds(Box outer, Box inner)
{
    return outer.low.x <= inner.low.x && outer.low.y <= inner.low.y && inner.high.x <= outer.high.x &&
           inner.high.y <= outer.high.y;
}

static inline bool box_meets(Box a, Box b)
{
    return !(b.low.x - a.high.x > 0 || b.low.y - a.high.y > 0 || a.low.x - b.high.x > 0 || a.low.y - b.high.y > 0);
}

static inline float box_perimeter(Box box)
{
    return 2.0f * ((box.high.x - box.low.x) + (box.high.y - box.low.y));
}

#endif
