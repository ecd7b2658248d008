/* Rigid bodies of polygons, and what the solver moves of them. */
#ifndef DREAMFLEET_RIGID_H
#define DREAMFLEET_RIGID_H

#include "polygon.h"

enum { FIXTURES = 4 };

typedef struct {
    Polygon polygon;
    Vec world[CORNERS];
    int leaf; /* in the tree of boxes */
} Fixture;

typedef struct {
    Pose pose, before; /* now, and where its centre of mass says that it was before the step */
    Vec centre;        /* of mass, in the body's frame */
    Vec at;            /* where the centre is */
    float angle;
    Vec velocity, force;
    float spin;
    float by_mass, by_inertia; /* one by them */
    float still;               /* seconds at rest */
    bool awake;
    int fixtures;
    Fixture fixture[FIXTURES];
} Rigid;

/* A body at rest at a place, without fixtures. */
void rigid_init(Rigid *body, Vec at, float angle);

/* One more fixture: the hull of points. */
void rigid_fix(Rigid *body, const Vec *points, int count);

/* The mass of all fixtures, of one density. */
void rigid_weigh(Rigid *body, float density);

void rigid_wake(Rigid *body);
void rigid_rest(Rigid *body);

/* The pose that follows from angle and centre of mass. */
Pose rigid_pose(const Rigid *body, Turn turn);

/* Pose and corners follow them. */
void rigid_place(Rigid *body);

#endif
