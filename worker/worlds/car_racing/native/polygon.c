/* Convex polygons as Box2D makes them: gift wrapping, and masses summed over triangles. */

#include "polygon.h"

static const float SKIN = 2.0f * 0.005f;

/* The point further right, the lower one of two. */
static int find_rightmost(const Vec *points, int count)
{
    int best = 0;
    for (int i = 1; i < count; i++)
        if (points[i].x > points[best].x || (points[i].x == points[best].x && points[i].y < points[best].y))
            best = i;
    return best;
}

/* The point that has no other to the right of the line from `from` to it; of several on the line the furthest. */
static int find_next(const Vec *points, int count, int from)
{
    int next = 0;
    for (int i = 1; i < count; i++) {
        if (next == from) {
            next = i;
            continue;
        }
        Vec best = vec_sub(points[next], points[from]), other = vec_sub(points[i], points[from]);
        float side = vec_cross(best, other);
        if (side < 0 || (side == 0 && vec_dot(other, other) > vec_dot(best, best)))
            next = i;
    }
    return next;
}

Polygon polygon_hull(const Vec *points, int count)
{
    Polygon hull = {0};
    int first = find_rightmost(points, count), at = first;
    do {
        hull.corners[hull.count++] = points[at];
        at = find_next(points, count, at);
    } while (at != first && hull.count < CORNERS);
    return hull;
}

Mass polygon_mass(const Polygon *polygon, float density)
{
    const float third = 1.0f / 3.0f;
    int count = polygon->count;
    Vec middle = {0, 0}, centre = {0, 0};
    float area = 0, moment = 0;
    for (int i = 0; i < count; i++)
        middle = vec_add(middle, polygon->corners[i]);
    middle = vec_scale(1.0f / (float)count, middle);
    for (int i = 0; i < count; i++) { /* triangles from the middle to each side */
        Vec a = vec_sub(polygon->corners[i], middle), b = vec_sub(polygon->corners[(i + 1) % count], middle);
        float twice = vec_cross(a, b), triangle = 0.5f * twice;
        area += triangle;
        centre = vec_add(centre, vec_scale(triangle * third, vec_add(a, b)));
        float xx = a.x * a.x + b.x * a.x + b.x * b.x, yy = a.y * a.y + b.y * a.y + b.y * b.y;
        moment += (0.25f * third * twice) * (xx + yy);
    }
    Mass mass = {.mass = density * area};
    centre = vec_scale(1.0f / area, centre);
    mass.centre = vec_add(centre, middle);
    mass.moment = density * moment + mass.mass * (vec_dot(mass.centre, mass.centre) - vec_dot(centre, centre));
    return mass;
}

void polygon_place(const Polygon *polygon, Pose pose, Vec *world)
{
    for (int i = 0; i < polygon->count; i++)
        world[i] = pose_out(pose, polygon->corners[i]);
}

Box polygon_box(const Vec *world, int count)
{
    Box box = {world[0], world[0]};
    for (int i = 1; i < count; i++)
        box = box_join(box, (Box){world[i], world[i]});
    Vec skin = {SKIN, SKIN};
    return (Box){vec_sub(box.low, skin), vec_add(box.high, skin)};
}
