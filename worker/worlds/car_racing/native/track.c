/* gymnasium's `_create_track`: a road that turns towards one checkpoint after the other, of which the second lap is kept
   if it closes, with borders where it turns hard. */

#include "track.h"

#include "plane.h"

static const double PI = 3.14159265358979323846, SCALE = 6, RADIUS = 900 / 6.0, STEP = 21 / 6.0, TURN = 0.31;
static const double ROAD = 40 / 6.0, BORDER = 8 / 6.0;
enum { HARD = 4 }; /* turns in a row, the same way, that have a border */

typedef struct {
    Waypoint checkpoints[CHECKPOINTS]; /* without beta */
    int next;                          /* checkpoint */
} Way;

static void place_checkpoints(Way *way, const double *draws)
{
    for (int c = 0; c < CHECKPOINTS; c++) {
        bool last = c == CHECKPOINTS - 1;
        double alpha = 2 * PI * c / CHECKPOINTS, radius = draws[2 * c + 1];
        if (c > 0 && !last)
            alpha += draws[2 * c];
        else
            radius = 1.5 * RADIUS;
        way->checkpoints[c] = (Waypoint){alpha, 0, radius * turn_cosine(alpha), radius * turn_sine(alpha)};
    }
    way->next = 0;
}

/* The next checkpoint that is not behind; `alpha` loses a turn after the last one. */
static const Waypoint *find_target(Way *way, double *alpha)
{
    for (;;) {
        do {
            const Waypoint *target = &way->checkpoints[way->next % CHECKPOINTS];
            if (*alpha <= target->alpha)
                return target;
            way->next++;
        } while (way->next % CHECKPOINTS);
        *alpha -= 2 * PI;
    }
}

/* From one checkpoint to the next, for five laps or as many steps as there is room for. */
static int wander(Way *way, Waypoint *points)
{
    double x = 1.5 * RADIUS, y = 0, beta = 0;
    bool other_side = false;
    int count = 0;
    for (int laps = 0; laps <= 4 && count < MOST_POINTS;) {
        double alpha = turn_towards(y, x);
        if (other_side && alpha > 0) {
            laps++;
            other_side = false;
        }
        if (alpha < 0) {
            other_side = true;
            alpha += 2 * PI;
        }
        const Waypoint *target = find_target(way, &alpha);
        double cosine = turn_cosine(beta), sine = turn_sine(beta);
        double across = cosine * (target->x - x) + sine * (target->y - y);
        while (beta - alpha > 1.5 * PI)
            beta -= 2 * PI;
        while (beta - alpha < -1.5 * PI)
            beta += 2 * PI;
        double before = beta;
        across *= SCALE;
        if (across > 0.3)
            beta -= fmin(TURN, fabs(0.001 * across));
        if (across < -0.3)
            beta += fmin(TURN, fabs(0.001 * across));
        x += -sine * STEP;
        y += cosine * STEP;
        points[count++] = (Waypoint){alpha, before * 0.5 + beta * 0.5, x, y};
    }
    return count;
}

/* Keeps what lies between the last two passes of the start; false if there are none, or if the ends do not meet. */
static bool close_lap(Track *track, int count)
{
    const double start = 2 * PI * -0.5 / CHECKPOINTS;
    Waypoint *points = track->points;
    int first = -1, last = -1;
    for (int i = count - 1; i > 0 && first < 0; i--)
        if (points[i].alpha > start && points[i - 1].alpha <= start)
            *(last < 0 ? &last : &first) = i;
    track->count = last - 1 - first;
    if (first < 0 || track->count <= HARD)
        return false;
    for (int i = 0; i < track->count; i++)
        points[i] = points[first + i];
    const Waypoint *end = &points[track->count - 1];
    double dx = turn_cosine(points[0].beta) * (points[0].x - end->x);
    double dy = turn_sine(points[0].beta) * (points[0].y - end->y);
    return sqrt(dx * dx + dy * dy) <= STEP;
}

/* Whether the road turned hard and one way for several points. */
static bool turns_hard(const Track *track, int i)
{
    int ways = 0;
    for (int back = 0; back < HARD; back++) {
        int at = (i - back + track->count) % track->count, before = (at + track->count - 1) % track->count;
        double turn = track->points[at].beta - track->points[before].beta;
        if (fabs(turn) <= TURN * 0.2)
            return false;
        ways += (int)sign(turn);
    }
    return ways == HARD || ways == -HARD;
}

/* The road's side at a point, `out` to the right of its middle; `way` is the cosine and the sine of where it goes. */
static Vector beside(const Waypoint *point, Vector way, double out)
{
    return (Vector){point->x + out * way.x, point->y + out * way.y};
}

static void add_quad(Track *track, const Vector *ways, int i, double left, double right, bool border)
{
    int last = (i + track->count - 1) % track->count;
    const Waypoint *here = &track->points[i], *before = &track->points[last];
    track->quads[track->quad_count++] = (Quad){
        {beside(here, ways[i], left), beside(here, ways[i], right), beside(before, ways[last], right),
         beside(before, ways[last], left)}, i, border};
}

bool track_make(Track *track, const double *draws)
{
    Way way;
    place_checkpoints(&way, draws);
    if (!close_lap(track, wander(&way, track->points)))
        return false;
    bool border[MOST_POINTS];
    Vector ways[MOST_POINTS];
    int count = track->count;
    for (int i = 0; i < count; i++) {
        border[i] = turns_hard(track, i);
        ways[i] = (Vector){turn_cosine(track->points[i].beta), turn_sine(track->points[i].beta)};
    }
    for (int i = 0; i < count; i++) /* one that reaches back over the first point goes on from the last ones */
        for (int back = 0; back < HARD; back++)
            border[(i - back + count) % count] |= border[i];
    track->quad_count = 0;
    for (int i = 0; i < count; i++) {
        add_quad(track, ways, i, -ROAD, ROAD, false);
        double side = sign(track->points[(i + count - 1) % count].beta - track->points[i].beta);
        if (border[i])
            add_quad(track, ways, i, side * ROAD, side * (ROAD + BORDER), true);
    }
    return true;
}
