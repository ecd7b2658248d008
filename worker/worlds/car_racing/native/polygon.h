/* Convex polygons: their hull, mass and box, and whether two of them meet. */
#ifndef DREAMFLEET_POLYGON_H
#define DREAMFLEET_POLYGON_H

#include "plane.h"

enum { CORNERS = 8 };

typedef struct {
    int count;
    Vec corners[CORNERS]; /* anticlockwise, in the frame of the body */
} Polygon;

/* Mass, its centre, and its moment about the body's origin. */
typedef struct {
    float mass;
    Vec centre;
    float moment;
} Mass;

/* A polygon where it stands. */
typedef struct {
    int count;
    const Vec *local, *world;
    Turn turn;
} Standing;

/* The convex hull of at least three and at most CORNERS points, beginning on the right. */
Polygon polygon_hull(const Vec *points, int count);

Mass polygon_mass(const Polygon *polygon, float density);

/* Corners in the world, and the box around them and the polygon's skin. */
void polygon_place(const Polygon *polygon, Pose pose, Vec *world);
Box polygon_box(const Vec *world, int count);

/* Whether the polygons, each within its skin, meet. The order of the two may decide when they just do. */
bool polygons_meet(const Standing *first, const Standing *second);

#endif
