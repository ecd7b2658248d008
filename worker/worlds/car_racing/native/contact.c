/* Contacts between tiles and the car's fixtures, which are found, begin and end in Box2D's order. Tiles are sensors:
   a contact pushes nothing. It visits a tile, and it lets a wheel stand on it. */

#include "race.h"

#include <string.h>

Rigid *mover_body(Race *race, int mover)
{
    return &race->island.bodies[mover < FIXTURES ? HULL : mover - FIXTURES];
}

Fixture *mover_fixture(Race *race, int mover)
{
    return &mover_body(race, mover)->fixture[mover < FIXTURES ? mover : 0];
}

/* ---- what contacts change, as gymnasium's listener ---- */

static void visit(Race *race, int index)
{
    race->tiles[index].visited = true;
    race->reward += 1000.0 / race->tile_count;
    race->visited++;
    if (index == 0 && (double)race->visited / race->tile_count > race->lap_share)
        race->new_lap = true;
}

static void touch(Race *race, Contact contact, bool begins)
{
    Tile *tile = &race->tiles[contact.tile];
    tile->touching ^= (uint8_t)(1 << contact.mover);
    tile->plain = true;
    if (contact.mover < FIXTURES)
        return;
    race->wheels[contact.mover - FIXTURES].tiles += begins ? 1 : -1;
    if (begins && !tile->visited)
        visit(race, contact.tile);
}

/* ---- contacts ---- */

static void drop(Race *race, int index)
{
    Contact contact = race->contacts[index];
    Tile *tile = &race->tiles[contact.tile];
    uint8_t bit = (uint8_t)(1 << contact.mover);
    if (tile->touching & bit)
        touch(race, contact, false);
    tile->pairs &= (uint8_t)~bit;
    size_t after = (size_t)(--race->contact_count - index);
    memmove(&race->contacts[index], &race->contacts[index + 1], after * sizeof(Contact));
}

/* The leaf with the lower number comes first. */
static bool meets(Race *race, Contact contact)
{
    const Tile *tile = &race->tiles[contact.tile];
    const Fixture *fixture = mover_fixture(race, contact.mover);
    Standing road = {tile->polygon.count, tile->polygon.corners, tile->polygon.corners, {0, 1}};
    Standing mover = {fixture->polygon.count, fixture->polygon.corners, fixture->world,
                      mover_body(race, contact.mover)->pose.turn};
    return tile->leaf < fixture->leaf ? polygons_meet(&road, &mover) : polygons_meet(&mover, &road);
}

void contact_update(Race *race)
{
    for (int i = race->contact_count - 1; i >= 0; i--) {
        Contact contact = race->contacts[i];
        const Node *nodes = race->tree.nodes;
        Tile *tile = &race->tiles[contact.tile];
        if (!box_meets(nodes[tile->leaf].box, nodes[mover_fixture(race, contact.mover)->leaf].box))
            drop(race, i);
        else if (meets(race, contact) != (bool)(tile->touching & 1 << contact.mover))
            touch(race, contact, !(tile->touching & 1 << contact.mover));
    }
}

/* ---- pairs ---- */

typedef struct {
    int low, high; /* leaves */
    Contact contact;
} Pair;

enum { MOST_FOUND = 512 };

static bool is_before(const Pair *a, const Pair *b)
{
    return a->low < b->low || (a->low == b->low && a->high < b->high);
}

/* The pairs of one fixture that are no contacts yet go, in the order of their leaves, among those of others. */
static int find_pairs(Race *race, int mover, Pair *pairs, int count)
{
    int found[MOST_FOUND], leaf = mover_fixture(race, mover)->leaf;
    int leaves = tree_query(&race->tree, leaf, found, MOST_FOUND);
    for (int i = 0; i < leaves && count < MOST_FOUND; i++) {
        int tile = race->tree.nodes[found[i]].owner;
        if (tile < 0 || race->tiles[tile].pairs & 1 << mover)
            continue;
        Pair pair = {found[i] < leaf ? found[i] : leaf, found[i] < leaf ? leaf : found[i], {tile, mover}};
        int at = count++;
        for (; at > 0 && is_before(&pair, &pairs[at - 1]); at--)
            pairs[at] = pairs[at - 1];
        pairs[at] = pair;
    }
    return count;
}

/* `moved` has a bit for each fixture. */
static void find_contacts(Race *race, unsigned moved)
{
    Pair pairs[MOST_FOUND];
    int count = 0;
    for (int mover = 0; mover < MOVERS; mover++)
        if (moved & 1u << mover)
            count = find_pairs(race, mover, pairs, count);
    for (int i = 0; i < count; i++) {
        race->tiles[pairs[i].contact.tile].pairs |= (uint8_t)(1 << pairs[i].contact.mover);
        race->contacts[race->contact_count++] = pairs[i].contact;
    }
}

void contact_follow(Race *race)
{
    unsigned moved = 0;
    for (int mover = MOVERS - 1; mover >= 0; mover--) { /* the newest first */
        const Rigid *body = mover_body(race, mover);
        const Fixture *fixture = mover_fixture(race, mover);
        Vec world[CORNERS];
        polygon_place(&fixture->polygon, body->before, world);
        Box box = polygon_box(world, fixture->polygon.count);
        box = box_join(box, polygon_box(fixture->world, fixture->polygon.count));
        if (tree_move(&race->tree, fixture->leaf, box, vec_sub(body->pose.at, body->before.at)))
            moved |= 1u << mover;
    }
    find_contacts(race, moved);
}

/* ---- episodes ---- */

void contact_enter_tiles(Race *race)
{
    for (int i = 0; i < race->tile_count; i++) {
        Tile *tile = &race->tiles[i];
        tile->leaf = tree_add(&race->tree, polygon_box(tile->polygon.corners, tile->polygon.count), i);
    }
}

void contact_enter_car(Race *race)
{
    for (int mover = 0; mover < MOVERS; mover++) {
        Fixture *fixture = mover_fixture(race, mover);
        Box box = polygon_box(fixture->world, fixture->polygon.count);
        fixture->leaf = tree_add(&race->tree, box, NOBODY);
    }
    find_contacts(race, (1u << MOVERS) - 1);
}

void contact_leave_tiles(Race *race)
{
    for (int i = 0; i < race->tile_count; i++)
        tree_remove(&race->tree, race->tiles[i].leaf);
    race->tile_count = race->contact_count = 0;
}

void contact_leave_car(Race *race)
{
    while (race->contact_count)
        drop(race, race->contact_count - 1);
    for (int mover = FIXTURES - 1; mover >= 0; mover--) /* a body's newest fixture first, but its oldest body */
        tree_remove(&race->tree, mover_fixture(race, mover)->leaf);
    for (int mover = FIXTURES; mover < MOVERS; mover++)
        tree_remove(&race->tree, mover_fixture(race, mover)->leaf);
}
