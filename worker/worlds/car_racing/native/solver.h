/* Moves a hull and its wheels for one step. */
#ifndef DREAMFLEET_SOLVER_H
#define DREAMFLEET_SOLVER_H

#include "joint.h"

enum { WHEELS = 4, HULL = WHEELS, BODIES = WHEELS + 1 };

/* One hull and the wheels that it holds: they are always one island. */
typedef struct {
    Rigid bodies[BODIES]; /* the wheels, then the hull */
    Joint joints[WHEELS];
    Impulse impulses[WHEELS];
    float by_dt; /* one by the step before; 0 before the first */
} Island;

void solver_step(Island *island, float dt, int velocity_rounds, int place_rounds);

#endif
