/* CarRacing without its picture: a track of tiles, the car on it, and what is counted. */
#ifndef DREAMFLEET_RACE_H
#define DREAMFLEET_RACE_H

#include "solver.h"
#include "track.h"
#include "tree.h"

#include <stdint.h>

enum { MOVERS = FIXTURES + WHEELS, SHADES = 3 };

/* What gymnasium keeps of a wheel. */
typedef struct {
    double steer, gas, brake, phase, omega;
    int tiles; /* that it stands on */
} Wheel;

/* Bit i of `pairs` and `touching` is for the fixture i that moves: the hull's four, then the wheels. */
typedef struct {
    Polygon polygon;
    int leaf;
    uint8_t pairs, touching;
    bool visited;
    bool plain; /* drawn in the road's own colour: something has come upon it or left it */
} Tile;

/* As 0xrrggbb: the road's, of one tile after the other, of which the first is the plain one; the field's and its patches'. */
typedef struct {
    uint32_t road[SHADES], ground, patch;
} Colours;

/* A tile and a fixture whose boxes meet. */
typedef struct {
    int tile, mover;
} Contact;

typedef struct {
    Track track;
    Colours colours;
    Tree tree; /* lives on from episode to episode, as gymnasium's world does */
    Tile *tiles;
    int tile_count;
    Contact *contacts; /* the newest last */
    int contact_count;
    Island island;
    Wheel wheels[WHEELS];
    double reward, reward_before, time, lap_share;
    double shown; /* the reward that the picture shows: before the step's time is paid */
    int visited;
    bool new_lap;
} Race;

/* What a step says. */
typedef struct {
    double reward;
    enum { GOES_ON, LAP_FINISHED, LEFT_THE_FIELD } end;
} Outcome;

void race_init(Race *race);
void race_free(Race *race);

/* A new episode on the track of these draws, and one step without an action. The colours are the road's, the field's and
   its patches', red, green and blue each. */
typedef enum { BEGUN, NO_TRACK, NO_MEMORY } Beginning;
Beginning race_reset(Race *race, const double *draws, double lap_share, const double *colours);

/* A new car at a place; what was visited stays so. */
void race_place(Race *race, double angle, double x, double y);

/* A step without an action, which pays nothing. */
void race_idle(Race *race);

Outcome race_step(Race *race, double steering, double gas, double brake);

/* ---- the car, of car.c ---- */

void car_init(Race *race, double angle, double x, double y);
void car_control(Race *race, double steer, double gas, double brake);
void car_roll(Race *race, double dt);

/* ---- contacts, of contact.c ---- */

/* The body of a fixture that moves, and the fixture. */
Rigid *mover_body(Race *race, int mover);
Fixture *mover_fixture(Race *race, int mover);

/* Tiles or the car enter and leave the tree. */
void contact_enter_tiles(Race *race);
void contact_enter_car(Race *race);
void contact_leave_tiles(Race *race);
void contact_leave_car(Race *race);

/* Contacts begin and end where the bodies are now. */
void contact_update(Race *race);

/* Fixtures have moved: the tree follows, and pairs whose boxes newly meet become contacts. */
void contact_follow(Race *race);

#endif
