/* What holds a wheel to the hull: a pin about which it turns, with a motor that steers it and a limit on both sides. */
#ifndef DREAMFLEET_JOINT_H
#define DREAMFLEET_JOINT_H

#include "rigid.h"

/* A body while the solver works on it. */
typedef struct {
    Vec velocity;
    float spin;
} Motion;

typedef struct {
    Vec at;
    float angle;
} Place;

/* What a joint has pushed in a step so far; the next step begins with it. */
typedef struct {
    Vec pin;
    float limit, motor;
} Impulse;

typedef struct {
    int hull, wheel; /* bodies */
    Vec anchor;      /* in the hull's frame; in the wheel's it is the origin */
    float speed;     /* of the motor */
    enum { BETWEEN, LOWEST, HIGHEST } limit;
    /* of this step, from the bodies' places: arms from the centres of mass, and the mass that the pin feels, a
       symmetric matrix of x, y and turn, with what its solutions are divided by */
    Vec hull_arm, wheel_arm;
    float hull_by_mass, hull_by_inertia, wheel_by_mass, wheel_by_inertia;
    float xx, xy, xt, yy, yt, tt;
    float by_flat, by_whole, motor_mass;
} Joint;

/* The angle between the bodies. */
float joint_angle(const Joint *joint, const Rigid *bodies);

/* Turns the motor, which wakes both bodies. */
void joint_drive(Joint *joint, Rigid *bodies, float speed);

/* Ready for the step's rounds; the impulse of the step before is applied, scaled by `ratio`. */
void joint_begin(Joint *joint, const Rigid *bodies, Impulse *impulse, Motion *motions, float ratio);

/* One round over the velocities of the hull and wheels of all its joints, the last joint first. */
void joints_hold(const Joint *joints, int count, Impulse *impulses, Motion *motions, float dt);

/* A round over the places; true if they are near enough to what the joint demands. */
bool joint_mend(const Joint *joint, const Rigid *bodies, Place *places);

#endif
