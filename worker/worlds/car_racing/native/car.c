/* gymnasium's car: how it is built, how it obeys, and what its wheels push. The arithmetic is in double precision and
   in gymnasium's order; what it reads of a body is in single precision, and so is what it gives to one. */

#include "race.h"

#define SIZE 0.02
static const double RADIUS = 1.0 * 27 * SIZE, STIFFNESS = 205000 * SIZE * SIZE, ENGINE = 100000000 * SIZE * SIZE;
static const double INERTIA = 4000 * SIZE * SIZE, GRIP = 1000000 * SIZE * SIZE;
static const double BRAKE = 15; /* radians per second that a full brake takes off in a step */

static const struct {
    int count, corners[CORNERS][2];
} HULL_PARTS[FIXTURES] = {
    {4, {{-60, 130}, {60, 130}, {60, 110}, {-60, 110}}},
    {4, {{-15, 120}, {15, 120}, {20, 20}, {-20, 20}}},
    {8, {{25, 20}, {50, -10}, {50, -40}, {20, -90}, {-20, -90}, {-50, -40}, {-50, -10}, {-25, 20}}},
    {4, {{-50, -120}, {50, -120}, {50, -90}, {-50, -90}}},
};
static const int TYRE[4][2] = {{-14, 27}, {14, 27}, {14, -27}, {-14, -27}};
static const int AXLES[WHEELS][2] = {{-55, 80}, {55, 80}, {-55, -82}, {55, -82}};

static void fix(Rigid *body, const int (*corners)[2], int count)
{
    Vec points[CORNERS];
    for (int i = 0; i < count; i++)
        points[i] = (Vec){(float)(corners[i][0] * SIZE), (float)(corners[i][1] * SIZE)};
    rigid_fix(body, points, count);
}

void car_init(Race *race, double angle, double x, double y)
{
    Island *island = &race->island;
    Rigid *hull = &island->bodies[HULL];
    rigid_init(hull, (Vec){(float)x, (float)y}, (float)angle);
    for (int i = 0; i < FIXTURES; i++)
        fix(hull, HULL_PARTS[i].corners, HULL_PARTS[i].count);
    rigid_weigh(hull, 1.0f);
    for (int i = 0; i < WHEELS; i++) { /* beside the hull as if it stood upright; the joints pull them into place */
        double across = AXLES[i][0] * SIZE, along = AXLES[i][1] * SIZE;
        Rigid *wheel = &island->bodies[i];
        rigid_init(wheel, (Vec){(float)(x + across), (float)(y + along)}, (float)angle);
        fix(wheel, TYRE, 4);
        rigid_weigh(wheel, 0.1f);
        island->joints[i] = (Joint){.hull = HULL, .wheel = i, .anchor = {(float)across, (float)along}};
        island->impulses[i] = (Impulse){0};
        race->wheels[i] = (Wheel){0};
    }
}

void car_control(Race *race, double steer, double gas, double brake)
{
    Wheel *wheels = race->wheels;
    wheels[0].steer = wheels[1].steer = steer;
    gas = fmin(fmax(gas, 0), 1);
    for (int i = 2; i < WHEELS; i++) { /* it rises by at most 0.1 a step and falls at once */
        double more = gas - wheels[i].gas;
        wheels[i].gas += more > 0.1 ? 0.1 : more;
    }
    for (int i = 0; i < WHEELS; i++)
        wheels[i].brake = brake;
}

/* The wheel's angular velocity after gas and brake. */
static double spin(const Wheel *wheel, double dt)
{
    double omega = wheel->omega + dt * ENGINE * wheel->gas / INERTIA / (fabs(wheel->omega) + 5.0);
    if (wheel->brake >= 0.9)
        return 0;
    return wheel->brake > 0 ? omega - sign(omega) * fmin(BRAKE * wheel->brake, fabs(omega)) : omega;
}

static void roll(Wheel *wheel, Rigid *body, double dt)
{
    double limit = wheel->tiles ? GRIP : GRIP * 0.6;
    double cosine = body->pose.turn.cosine, sine = body->pose.turn.sine; /* forwards is (-sine, cosine) */
    double vx = body->velocity.x, vy = body->velocity.y, ahead = -sine * vx + cosine * vy;
    double omega = spin(wheel, dt);
    wheel->phase += omega * dt;
    double forwards = (-ahead + omega * RADIUS) * STIFFNESS, sideways = -(cosine * vx + sine * vy) * STIFFNESS;
    double force = sqrt(forwards * forwards + sideways * sideways);
    if (force > limit) {
        forwards = forwards / force * limit;
        sideways = sideways / force * limit;
    }
    wheel->omega = omega - dt * forwards * RADIUS / INERTIA;
    rigid_wake(body);
    Vec push = {(float)(sideways * cosine + forwards * -sine), (float)(sideways * sine + forwards * cosine)};
    body->force = vec_add(body->force, push);
}

void car_roll(Race *race, double dt)
{
    Island *island = &race->island;
    for (int i = 0; i < WHEELS; i++) {
        double turn = race->wheels[i].steer - joint_angle(&island->joints[i], island->bodies);
        joint_drive(&island->joints[i], island->bodies, (float)(sign(turn) * fmin(50.0 * fabs(turn), 3.0)));
        roll(&race->wheels[i], &island->bodies[i], dt);
    }
}
