/* An episode of CarRacing: gymnasium's reset and step but for track and picture. */

#include "race.h"

#include <stdlib.h>

static const double STEP = 1.0 / 50, FIELD = 2000 / 6.0;
enum { VELOCITY_ROUNDS = 6 * 30, PLACE_ROUNDS = 2 * 30 };

void race_init(Race *race)
{
    *race = (Race){0};
    tree_init(&race->tree);
}

void race_free(Race *race)
{
    tree_free(&race->tree);
    free(race->tiles);
    free(race->contacts);
    race_init(race);
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
static void advance(Race *race)
{
    car_roll(race, STEP);
    contact_update(race);
    solver_step(&race->island, (float)STEP, VELOCITY_ROUNDS, PLACE_ROUNDS);
    contact_follow(race);
    race->time += STEP;
}

bool race_reset(Race *race, const double *corners, int tiles, double angle, double x, double y, double lap_share)
{
    if (race->tile_count)
        contact_leave(race);
    race->tile_count = 0;
    if (!reserve(race, tiles))
        return false;
    for (int i = 0; i < tiles; i++, corners += 2 * TILE_CORNERS) {
        Vec points[TILE_CORNERS];
        for (int k = 0; k < TILE_CORNERS; k++)
            points[k] = (Vec){(float)corners[2 * k], (float)corners[2 * k + 1]};
        race->tiles[i] = (Tile){.polygon = polygon_hull(points, TILE_CORNERS)};
    }
    race->tile_count = tiles;
    race->reward = race->reward_before = race->time = 0;
    race->lap_share = lap_share;
    race->visited = 0;
    race->new_lap = false;
    car_init(race, angle, x, y);
    contact_enter(race);
    advance(race);
    return true;
}

Outcome race_step(Race *race, double steering, double gas, double brake)
{
    car_control(race, -steering, gas, brake);
    advance(race);
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
