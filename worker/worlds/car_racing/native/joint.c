/* Box2D's revolute joint. With hull a, wheel b, arms r, and i and m one by inertia and mass, the pin wants

     v_b + w_b x r_b - v_a - w_a x r_a = 0,   the limit w_b - w_a = 0,   the motor w_b - w_a = speed.

   Each iteration finds the impulse that reaches this at once for one joint alone, and the other joints disturb it. */

#include "joint.h"

#define PI 3.14159265359f
static const float LOWER = -0.4f, UPPER = 0.4f;
static const float TORQUE = (float)(180 * 900 * 0.02 * 0.02);
static const float NOTHING = -0.0f; /* which changes no sum: 0.0f would change -0.0f */
static const float SLOP = 0.005f, ANGLE_SLOP = 2.0f / 180.0f * PI, MOST_TURN = 8.0f / 180.0f * PI;

float joint_angle(const Joint *joint, const Rigid *bodies)
{
    return bodies[joint->wheel].angle - bodies[joint->hull].angle;
}

void joint_drive(Joint *joint, Rigid *bodies, float speed)
{
    rigid_wake(&bodies[joint->hull]);
    rigid_wake(&bodies[joint->wheel]);
    joint->speed = speed;
}

/* Both bodies receive an impulse, the hull the other way. */
static void push(const Joint *joint, Motion *hull, Motion *wheel, Impulse impulse)
{
    hull->velocity = vec_sub(hull->velocity, vec_scale(joint->hull_by_mass, impulse.pin));
    hull->spin -= joint->hull_by_inertia * (vec_cross(joint->hull_arm, impulse.pin) + impulse.motor + impulse.limit);
    wheel->velocity = vec_add(wheel->velocity, vec_scale(joint->wheel_by_mass, impulse.pin));
    wheel->spin += joint->wheel_by_inertia * (vec_cross(joint->wheel_arm, impulse.pin) + impulse.motor + impulse.limit);
}

static Vec pin_arm(const Joint *joint, const Rigid *bodies, bool wheel, Turn turn)
{
    Vec anchor = wheel ? (Vec){0, 0} : joint->anchor;
    return turn_out(turn, vec_sub(anchor, bodies[wheel ? joint->wheel : joint->hull].centre));
}

static void weigh(Joint *joint)
{
    Vec a = joint->hull_arm, b = joint->wheel_arm;
    float m = joint->hull_by_mass + joint->wheel_by_mass, i = joint->hull_by_inertia, j = joint->wheel_by_inertia;
    joint->xx = m + a.y * a.y * i + b.y * b.y * j;
    joint->xy = -a.y * a.x * i - b.y * b.x * j;
    joint->xt = -a.y * i - b.y * j;
    joint->yy = m + a.x * a.x * i + b.x * b.x * j;
    joint->yt = a.x * i + b.x * j;
    joint->tt = i + j;
    joint->motor_mass = 1.0f / joint->tt;
    float flat = joint->xx * joint->yy - joint->xy * joint->xy;
    joint->by_flat = flat != 0 ? 1.0f / flat : flat;
    float whole = joint->xx * (joint->yy * joint->tt - joint->yt * joint->yt) +
                  joint->xy * (joint->yt * joint->xt - joint->xy * joint->tt) +
                  joint->xt * (joint->xy * joint->yt - joint->yy * joint->xt);
    joint->by_whole = whole != 0 ? 1.0f / whole : whole;
}

void joint_begin(Joint *joint, const Rigid *bodies, Impulse *impulse, Motion *motions, float ratio)
{
    const Rigid *hull = &bodies[joint->hull], *wheel = &bodies[joint->wheel];
    joint->hull_arm = pin_arm(joint, bodies, false, hull->pose.turn);
    joint->wheel_arm = pin_arm(joint, bodies, true, wheel->pose.turn);
    joint->hull_by_mass = hull->by_mass;
    joint->hull_by_inertia = hull->by_inertia;
    joint->wheel_by_mass = wheel->by_mass;
    joint->wheel_by_inertia = wheel->by_inertia;
    weigh(joint);

    float angle = joint_angle(joint, bodies);
    int limit = angle <= LOWER ? LOWEST : angle >= UPPER ? HIGHEST : BETWEEN;
    if (limit == BETWEEN || limit != (int)joint->limit)
        impulse->limit = 0;
    joint->limit = limit;

    impulse->pin = vec_scale(ratio, impulse->pin);
    impulse->limit *= ratio;
    impulse->motor *= ratio;
    push(joint, &motions[joint->hull], &motions[joint->wheel], *impulse);
}

static void drive(const Joint *joint, Impulse *impulse, Motion *hull, Motion *wheel, float dt)
{
    float most = dt * TORQUE, before = impulse->motor;
    float wanted = -joint->motor_mass * (wheel->spin - hull->spin - joint->speed);
    impulse->motor = clamp(before + wanted, -most, most);
    float turn = impulse->motor - before;
    hull->spin -= joint->hull_by_inertia * turn;
    wheel->spin += joint->wheel_by_inertia * turn;
}

/* How the two ends of the pin move apart. */
static Vec drift(const Joint *joint, const Motion *hull, const Motion *wheel)
{
    Vec a = joint->hull_arm, b = joint->wheel_arm;
    return (Vec){wheel->velocity.x - wheel->spin * b.y - hull->velocity.x + hull->spin * a.y,
                 wheel->velocity.y + wheel->spin * b.x - hull->velocity.y - hull->spin * a.x};
}

/* The pin's impulse against a drift, if only the pin pushes. */
static Vec solve_flat(const Joint *joint, Vec drift)
{
    return (Vec){joint->by_flat * (joint->yy * drift.x - joint->xy * drift.y),
                 joint->by_flat * (joint->xx * drift.y - joint->xy * drift.x)};
}

/* At a limit pin and limit push together, unless the limit would have to pull: then it lets go. */
static void hold_limit(const Joint *joint, Impulse *impulse, Motion *hull, Motion *wheel)
{
    Vec apart = drift(joint, hull, wheel);
    float turn = wheel->spin - hull->spin;
    float xx = joint->xx, xy = joint->xy, xt = joint->xt, yy = joint->yy, yt = joint->yt, tt = joint->tt;
    float x = apart.x * (yy * tt - yt * yt) + apart.y * (yt * xt - xy * tt) + turn * (xy * yt - yy * xt);
    float y = xx * (apart.y * tt - turn * yt) + xy * (turn * xt - apart.x * tt) + xt * (apart.x * yt - apart.y * xt);
    float t = xx * (yy * turn - yt * apart.y) + xy * (yt * apart.x - xy * turn) + xt * (xy * apart.y - yy * apart.x);
    Vec pin = {-(joint->by_whole * x), -(joint->by_whole * y)};
    float stop = -(joint->by_whole * t), sum = impulse->limit + stop;
    if (joint->limit == LOWEST ? sum < 0 : sum > 0) {
        Vec rest = vec_scale(impulse->limit, (Vec){xt, yt});
        pin = solve_flat(joint, vec_add((Vec){-apart.x, -apart.y}, rest));
        stop = -impulse->limit;
        impulse->limit = 0;
    } else {
        impulse->limit = sum;
    }
    impulse->pin = vec_add(impulse->pin, pin);
    push(joint, hull, wheel, (Impulse){pin, stop, NOTHING});
}

static void hold(const Joint *joint, Impulse *impulse, Motion *hull, Motion *wheel, float dt)
{
    drive(joint, impulse, hull, wheel, dt);
    if (joint->limit != BETWEEN) {
        hold_limit(joint, impulse, hull, wheel);
        return;
    }
    Vec apart = drift(joint, hull, wheel), pin = solve_flat(joint, (Vec){-apart.x, -apart.y});
    impulse->pin = vec_add(impulse->pin, pin);
    push(joint, hull, wheel, (Impulse){pin, NOTHING, NOTHING});
}

void joints_hold(const Joint *joints, int count, Impulse *impulses, Motion *motions, float dt)
{
    Motion hull = motions[joints->hull]; /* in registers */
    for (int i = count - 1; i >= 0; i--)
        hold(&joints[i], &impulses[i], &hull, &motions[joints[i].wheel], dt);
    motions[joints->hull] = hull;
}

/* Turns both bodies back to the limit; how far they were beyond it. */
static float mend_limit(const Joint *joint, Place *hull, Place *wheel)
{
    if (joint->limit == BETWEEN)
        return 0;
    float angle = wheel->angle - hull->angle, error, back;
    if (joint->limit == LOWEST) {
        error = -(angle - LOWER);
        back = clamp(angle - LOWER + ANGLE_SLOP, -MOST_TURN, 0.0f);
    } else {
        error = angle - UPPER;
        back = clamp(angle - UPPER - ANGLE_SLOP, 0.0f, MOST_TURN);
    }
    float turn = -joint->motor_mass * back;
    hull->angle -= joint->hull_by_inertia * turn;
    wheel->angle += joint->wheel_by_inertia * turn;
    return error;
}

bool joint_mend(const Joint *joint, const Rigid *bodies, Place *places)
{
    Place *hull = &places[joint->hull], *wheel = &places[joint->wheel];
    float beyond = mend_limit(joint, hull, wheel);
    Vec a = pin_arm(joint, bodies, false, turn_by(hull->angle));
    Vec b = pin_arm(joint, bodies, true, turn_by(wheel->angle));
    Vec apart = vec_sub(vec_sub(vec_add(wheel->at, b), hull->at), a);

    float m = joint->hull_by_mass, n = joint->wheel_by_mass, i = joint->hull_by_inertia, j = joint->wheel_by_inertia;
    float xx = m + n + i * a.y * a.y + j * b.y * b.y, yy = m + n + i * a.x * a.x + j * b.x * b.x;
    float xy = -i * a.x * a.y - j * b.x * b.y, whole = xx * yy - xy * xy;
    whole = whole != 0 ? 1.0f / whole : whole;
    Vec push = {-(whole * (yy * apart.x - xy * apart.y)), -(whole * (xx * apart.y - xy * apart.x))};

    hull->at = vec_sub(hull->at, vec_scale(m, push));
    hull->angle -= i * vec_cross(a, push);
    wheel->at = vec_add(wheel->at, vec_scale(n, push));
    wheel->angle += j * vec_cross(b, push);
    return vec_length(apart) <= SLOP && beyond <= ANGLE_SLOP;
}
