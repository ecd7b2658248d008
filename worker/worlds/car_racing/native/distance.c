/* Whether two convex polygons meet, by the distance between them: the algorithm of Gilbert, Johnson and Keerthi over
   the differences of their points. The nearest difference to the origin is sought in a simplex of one to three
   differences of corners, of which the parts that are further away are dropped, as Ericson describes it. */

#include "polygon.h"

#include <float.h>

enum { MOST_STEPS = 20 };
static const float SKINS = 2.0f * 0.005f + 2.0f * 0.005f; /* of both polygons */

typedef struct {
    int first, second; /* corners */
    Vec from, to, gap; /* where they are, and the way between them */
    float share;       /* of the nearest difference */
} Difference;

typedef struct {
    int count;
    Difference parts[3];
} Simplex;

static int find_furthest(const Standing *polygon, Vec way)
{
    Vec local = turn_in(polygon->turn, way);
    int best = 0;
    float furthest = vec_dot(polygon->local[0], local);
    for (int i = 1; i < polygon->count; i++) {
        float reach = vec_dot(polygon->local[i], local);
        if (reach > furthest) {
            best = i;
            furthest = reach;
        }
    }
    return best;
}

static Difference difference(const Standing *first, int i, const Standing *second, int j)
{
    return (Difference){i, j, first->world[i], second->world[j], vec_sub(second->world[j], first->world[i]), 1.0f};
}

static Simplex corner_of(Difference part)
{
    part.share = 1.0f;
    return (Simplex){1, {part}};
}

/* Between two differences; `a` and `b` are what lies opposite each, in parts of the whole. */
static Simplex side_of(Difference first, Difference second, float a, float b)
{
    float whole = 1.0f / (a + b);
    first.share = a * whole;
    second.share = b * whole;
    return (Simplex){2, {first, second}};
}

static Simplex nearest_of_two(const Simplex *simplex)
{
    Difference first = simplex->parts[0], second = simplex->parts[1];
    Vec side = vec_sub(second.gap, first.gap);
    float b = -vec_dot(first.gap, side), a = vec_dot(second.gap, side);
    if (b <= 0)
        return corner_of(first);
    return a <= 0 ? corner_of(second) : side_of(first, second, a, b);
}

/* The corner, side or inside of the triangle that is nearest to the origin; the order of the questions counts. */
static Simplex nearest_of_three(const Simplex *simplex)
{
    Difference p = simplex->parts[0], q = simplex->parts[1], r = simplex->parts[2];
    Vec pq = vec_sub(q.gap, p.gap), pr = vec_sub(r.gap, p.gap), qr = vec_sub(r.gap, q.gap);
    float pq_q = -vec_dot(p.gap, pq), pq_p = vec_dot(q.gap, pq);
    float pr_r = -vec_dot(p.gap, pr), pr_p = vec_dot(r.gap, pr);
    float qr_r = -vec_dot(q.gap, qr), qr_q = vec_dot(r.gap, qr);
    float turn = vec_cross(pq, pr);
    float at_p = turn * vec_cross(q.gap, r.gap), at_q = turn * vec_cross(r.gap, p.gap);
    float at_r = turn * vec_cross(p.gap, q.gap);
    if (pq_q <= 0 && pr_r <= 0)
        return corner_of(p);
    if (pq_p > 0 && pq_q > 0 && at_r <= 0)
        return side_of(p, q, pq_p, pq_q);
    if (pr_p > 0 && pr_r > 0 && at_q <= 0)
        return side_of(p, r, pr_p, pr_r);
    if (pq_p <= 0 && qr_r <= 0)
        return corner_of(q);
    if (pr_p <= 0 && qr_q <= 0)
        return corner_of(r);
    if (qr_q > 0 && qr_r > 0 && at_p <= 0)
        return side_of(r, q, qr_r, qr_q);
    return *simplex; /* the origin is inside */
}

/* From the simplex towards the origin. */
static Vec way_to_origin(const Simplex *simplex)
{
    Vec first = simplex->parts[0].gap;
    if (simplex->count == 1)
        return (Vec){-first.x, -first.y};
    Vec side = vec_sub(simplex->parts[1].gap, first);
    if (vec_cross(side, (Vec){-first.x, -first.y}) > 0)
        return (Vec){-side.y, side.x};
    return (Vec){side.y, -side.x};
}

static float distance_of(const Simplex *simplex)
{
    const Difference *a = &simplex->parts[0], *b = &simplex->parts[1];
    if (simplex->count == 1)
        return vec_length(vec_sub(a->from, a->to));
    Vec from = vec_add(vec_scale(a->share, a->from), vec_scale(b->share, b->from));
    Vec to = vec_add(vec_scale(a->share, a->to), vec_scale(b->share, b->to));
    return vec_length(vec_sub(from, to));
}

static bool has(const Simplex *simplex, int first, int second)
{
    for (int i = 0; i < simplex->count; i++)
        if (simplex->parts[i].first == first && simplex->parts[i].second == second)
            return true;
    return false;
}

bool polygons_meet(const Standing *first, const Standing *second)
{
    Simplex simplex = corner_of(difference(first, 0, second, 0));
    for (int step = 0; step < MOST_STEPS; step++) {
        Simplex before = simplex;
        if (simplex.count == 2)
            simplex = nearest_of_two(&before);
        else if (simplex.count == 3)
            simplex = nearest_of_three(&before);
        if (simplex.count == 3)
            return true;
        Vec way = way_to_origin(&simplex);
        if (vec_dot(way, way) < FLT_EPSILON * FLT_EPSILON)
            break;
        int i = find_furthest(first, (Vec){-way.x, -way.y}), j = find_furthest(second, way);
        if (has(&before, i, j)) /* no corner is nearer */
            break;
        simplex.parts[simplex.count++] = difference(first, i, second, j);
    }
    if (simplex.count == 3)
        return true;
    float distance = distance_of(&simplex);
    return !(distance > SKINS && distance > FLT_EPSILON) || distance - SKINS < 10.0f * FLT_EPSILON;
}
