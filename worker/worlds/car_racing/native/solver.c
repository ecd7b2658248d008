/* Box2D's step of an island: forces, then rounds over the joints' velocities, places, rounds over the joints' places,
   and sleep.

   What was found of the x86-64 wheel of box2d 2.3.10, by its machine code and by comparing bits: GCC 10 made it for
   SSE2, with no product fused into a sum and no sum rearranged; sine and cosine are glibc's `sincosf` (turn.c); `sqrtf`
   rounds correctly; a Python float is rounded to single precision as soon as it enters. */

#include "solver.h"

#include <float.h>
#include <string.h>

static const float LONGEST = 2.0f, WIDEST = 0.5f * 3.14159265359f; /* a step's way and turn, at most */
static const float STILL_SPEED = 0.01f, STILL_SPIN = 2.0f / 180.0f * 3.14159265359f, UNTIL_SLEEP = 0.5f;

/* All that a round over the velocities reads and writes. */
typedef struct {
    Motion motions[BODIES];
    Impulse impulses[WHEELS];
} Round;

static void begin(Island *island, Round *round, float dt)
{
    float ratio = island->by_dt * dt;
    for (int i = 0; i < BODIES; i++) {
        Rigid *body = &island->bodies[i];
        body->before = rigid_pose(body, body->pose.turn); /* a new body's origin says otherwise, by a rounding */
        Vec push = vec_add((Vec){0, 0}, vec_scale(body->by_mass, body->force)); /* no gravity, and no torque */
        round->motions[i] = (Motion){vec_add(body->velocity, vec_scale(dt, push)), body->spin + 0.0f};
    }
    memcpy(round->impulses, island->impulses, sizeof round->impulses);
    for (int i = WHEELS - 1; i >= 0; i--) /* the newest joint first, here and below */
        joint_begin(&island->joints[i], island->bodies, &round->impulses[i], round->motions, ratio);
}

/* A round is a function of what it changes. So as soon as a state comes back, all that follow are known: the rest is a
   whole number of periods, which change nothing, and a remainder. Most steps come to a state that stays after a few
   dozen of the 180 rounds. */
static void solve_velocities(const Island *island, Round *round, float dt, int rounds)
{
    Round seen = *round;
    for (int done = 0, seen_at = 0; done < rounds;) {
        joints_hold(island->joints, WHEELS, round->impulses, round->motions, dt);
        done++;
        if (memcmp(round, &seen, sizeof seen) == 0) {
            rounds = done + (rounds - done) % (done - seen_at);
        } else if ((done & (done - 1)) == 0) {
            seen = *round;
            seen_at = done;
        }
    }
}

/* No body goes or turns further in a step than Box2D allows. */
static void limit(Motion *motion, float dt)
{
    Vec way = vec_scale(dt, motion->velocity);
    if (vec_dot(way, way) > LONGEST * LONGEST)
        motion->velocity = vec_scale(LONGEST / vec_length(way), motion->velocity);
    float turn = dt * motion->spin;
    if (turn * turn > WIDEST * WIDEST)
        motion->spin *= WIDEST / (turn > 0 ? turn : -turn);
}

static bool solve_places(const Island *island, Place *places, int rounds)
{
    for (int round = 0; round < rounds; round++) {
        bool near = true;
        for (int i = WHEELS - 1; i >= 0; i--)
            near = joint_mend(&island->joints[i], island->bodies, places) && near;
        if (near)
            return true;
    }
    return false;
}

/* The island sleeps as a whole, once each body was slow for long enough. */
static void sleep_if_still(Island *island, float dt, bool near)
{
    float shortest = FLT_MAX;
    for (int i = 0; i < BODIES; i++) {
        Rigid *body = &island->bodies[i];
        bool moves = body->spin * body->spin > STILL_SPIN * STILL_SPIN ||
                     vec_dot(body->velocity, body->velocity) > STILL_SPEED * STILL_SPEED;
        body->still = moves ? 0 : body->still + dt;
        shortest = smaller(shortest, body->still);
    }
    for (int i = 0; near && shortest >= UNTIL_SLEEP && i < BODIES; i++)
        rigid_rest(&island->bodies[i]);
}

void solver_step(Island *island, float dt, int velocity_rounds, int place_rounds)
{
    Round round;
    Place places[BODIES];
    begin(island, &round, dt);
    solve_velocities(island, &round, dt, velocity_rounds);
    memcpy(island->impulses, round.impulses, sizeof island->impulses);
    for (int i = 0; i < BODIES; i++) {
        Motion *motion = &round.motions[i];
        limit(motion, dt);
        places[i].at = vec_add(island->bodies[i].at, vec_scale(dt, motion->velocity));
        places[i].angle = island->bodies[i].angle + dt * motion->spin;
    }
    bool near = solve_places(island, places, place_rounds);
    for (int i = 0; i < BODIES; i++) {
        Rigid *body = &island->bodies[i];
        body->at = places[i].at;
        body->angle = places[i].angle;
        body->velocity = round.motions[i].velocity;
        body->spin = round.motions[i].spin;
        rigid_place(body);
    }
    sleep_if_still(island, dt, near);
    island->by_dt = 1.0f / dt;
    for (int i = 0; i < BODIES; i++)
        island->bodies[i].force = (Vec){0, 0};
}
