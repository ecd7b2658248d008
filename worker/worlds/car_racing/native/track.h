/* CarRacing's track as gymnasium makes it from random numbers: arithmetic in double precision and in its order. */
#ifndef DREAMFLEET_TRACK_H
#define DREAMFLEET_TRACK_H

#include <stdbool.h>

enum { CHECKPOINTS = 12, DRAWS = 2 * CHECKPOINTS, MOST_POINTS = 2500, TILE_CORNERS = 4 };

typedef struct {
    double x, y;
} Vector;

/* A point of the centre line: its angle seen from the middle, the way the road goes there, and its place. */
typedef struct {
    double alpha, beta, x, y;
} Waypoint;

/* A road's tile, or the border beside it. */
typedef struct {
    Vector corners[TILE_CORNERS];
    int tile;
    bool border;
} Quad;

typedef struct {
    int count, quad_count;
    Waypoint points[MOST_POINTS]; /* a tile each, from the point before to this one */
    Quad quads[2 * MOST_POINTS];  /* in the order in which they are drawn */
} Track;

/* `draws` are of each checkpoint how far it is turned on and its distance from the middle, both uniform. False if the
   road does not close, as happens: other draws are needed. */
bool track_make(Track *track, const double *draws);

#endif
