/* An episode of CarRacing: gymnasium's reset and step but for track and picture. */

#include "race.h"

#include <stdlib.h>

static const double STEP = 1.0 / 50, FIELD = 2000 / 6.0;
enum { VELOCITY_ROUNDS = 6 * 30, PLACE_ROUNDS = 2 * 30 };

void race_init(Race *race)
{
    tree_init(&race->tree);
}

void race_free(Race *race)
{
    tree_free(&race->tree);
    free(race->tiles);
    free(race->contacts);
}

static bool reserve(Race *race, int tiles)
{
    Tile *more = realloc(race->tiles, (size_t)tiles * sizeof(Tile));
    if (!more)
        return false;
    race->tiles = more;
    Contact *contacts = realloc(race->contacts, (size_t)tiles * MOVERS * sizeof(Contact));
    if (!contacts)
        return false;
    race->contacts = contacts;
    return tree_reserve(&race->tree, tiles + MOVERS);
}

/* Wheels push, contacts of the step before begin and end, bodies move, and new contacts are found. */
void race_idle(Race *race)
{
    car_roll(race, STEP);
    contact_update(race);
    solver_step(&race->island, (float)STEP, VELOCITY_ROUNDS, PLACE_ROUNDS);
    contact_follow(race);
    race->time += STEP;
    race->shown = race->reward;
}

static void lay_tiles(Race *race)
{
    for (const Quad *quad = race->track.quads; race->tile_count < race->track.count; quad++) {
        if (quad->border)
            continue;
        Vec points[TILE_CORNERS];
        for (int k = 0; k < TILE_CORNERS; k++)
            points[k] = (Vec){(float)quad->corners[k].x, (float)quad->corners[k].y};
        race->tiles[race->tile_count++] = (Tile){.polygon = polygon_hull(points, TILE_CORNERS)};
    }
}

/* Colours are cut to whole numbers as they are drawn. */
static uint32_t pack(const double *rgb, double more)
{
    uint32_t packed = 0;
    for (int i = 0; i < 3; i++)
        packed = packed << 8 | ((uint32_t)(rgb[i] + more) & 255);
    return packed;
}

Beginning race_reset(Race *race, const double *draws, double lap_share, const double *colours)
{
    if (!track_make(&race->track, draws))
        return NO_TRACK;
    if (race->tile_count) {
        contact_leave_tiles(race);
        contact_leave_car(race);
    }
    if (!reserve(race, race->track.count))
        return NO_MEMORY;
    lay_tiles(race);
    for (int i = 0; i < SHADES; i++)
        race->colours.road[i] = pack(colours, 0.01 * i * 255);
    race->colours.ground = pack(colours + 3, 0);
    race->colours.patch = pack(colours + 6, 0);
    race->reward = race->reward_before = race->time = 0;
    race->lap_share = lap_share;
    race->visited = 0;
    race->new_lap = false;
    const Waypoint *start = race->track.points;
    car_init(race, start->beta, start->x, start->y);
    contact_enter_tiles(race);
    contact_enter_car(race);
    race_idle(race);
    return BEGUN;
}

void race_place(Race *race, double angle, double x, double y)
{
    contact_leave_car(race);
    car_init(race, angle, x, y);
    contact_enter_car(race);
}

Outcome race_step(Race *race, double steering, double gas, double brake)
{
    car_control(race, -steering, gas, brake);
    race_idle(race);
    race->reward -= 0.1;
    Outcome outcome = {race->reward - race->reward_before, GOES_ON};
    race->reward_before = race->reward;
    if (race->visited == race->tile_count || race->new_lap)
        outcome.end = LAP_FINISHED;
    Vec hull = race->island.bodies[HULL].pose.at;
    if (fabs((double)hull.x) > FIELD || fabs((double)hull.y) > FIELD)
        outcome = (Outcome){-100, LEFT_THE_FIELD};
    return outcome;
}
