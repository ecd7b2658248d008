/* `Race` for Python. */

#include "game.h"

#include "race.h"

typedef struct {
    PyObject_HEAD
    Race race;
} Game;

static PyObject *game_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    (void)keywords;
    if (!PyArg_ParseTuple(args, ""))
        return NULL;
    PyObject *self = ((allocfunc)PyType_GetSlot(type, Py_tp_alloc))(type, 0);
    if (self)
        race_init(&((Game *)self)->race);
    return self;
}

static void game_free(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);
    race_free(&((Game *)self)->race);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

static bool all_finite(const double *values, Py_ssize_t count)
{
    for (Py_ssize_t i = 0; i < count; i++)
        if (!isfinite(values[i]))
            return false;
    return true;
}

/* reset(tiles, (angle, x, y), lap_complete_percent) */
static PyObject *game_reset(PyObject *self, PyObject *args)
{
    Py_buffer tiles;
    double start[3], share;
    if (!PyArg_ParseTuple(args, "y*(ddd)d", &tiles, &start[0], &start[1], &start[2], &share))
        return NULL;
    Py_ssize_t tile = 2 * TILE_CORNERS * (Py_ssize_t)sizeof(double), count = tiles.len / tile;
    bool sound = tiles.len % tile == 0 && count > 0 && count < MOST_TILES &&
                 all_finite(tiles.buf, count * 2 * TILE_CORNERS) && all_finite(start, 3);
    if (!sound)
        PyErr_SetString(PyExc_ValueError, "a track has tiles of four corners each, in doubles, all finite");
    else if (!race_reset(&((Game *)self)->race, tiles.buf, (int)count, start[0], start[1], start[2], share))
        PyErr_NoMemory();
    PyBuffer_Release(&tiles);
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
}

/* step(steering, gas, brake): the reward, and whether a lap was finished; None as long as the episode goes on */
static PyObject *game_step(PyObject *self, PyObject *args)
{
    double action[3];
    Race *race = &((Game *)self)->race;
    if (!PyArg_ParseTuple(args, "ddd", &action[0], &action[1], &action[2]))
        return NULL;
    if (!race->tile_count || !all_finite(action, 3)) {
        PyErr_SetString(PyExc_ValueError, "an action is three finite numbers, after a reset");
        return NULL;
    }
    Outcome outcome = race_step(race, action[0], action[1], action[2]);
    PyObject *end = outcome.end == GOES_ON ? Py_None : outcome.end == LAP_FINISHED ? Py_True : Py_False;
    return Py_BuildValue("dO", outcome.reward, end);
}

/* body(index): x, y, angle, velocity x and y, spin, awake; wheels are 0 to 3, the hull is 4 */
static PyObject *game_body(PyObject *self, PyObject *index)
{
    long i = PyLong_AsLong(index);
    if (i < 0 || i >= BODIES) {
        if (!PyErr_Occurred())
            PyErr_SetString(PyExc_IndexError, "a car has a hull and four wheels");
        return NULL;
    }
    const Rigid *body = &((Game *)self)->race.island.bodies[i];
    return Py_BuildValue("ffffffO", body->pose.at.x, body->pose.at.y, body->angle, body->velocity.x, body->velocity.y,
                         body->spin, body->awake ? Py_True : Py_False);
}

/* wheel(index): omega, phase, gas, brake, steer, the joint's angle, tiles that it stands on */
static PyObject *game_wheel(PyObject *self, PyObject *index)
{
    long i = PyLong_AsLong(index);
    if (i < 0 || i >= WHEELS) {
        if (!PyErr_Occurred())
            PyErr_SetString(PyExc_IndexError, "a car has four wheels");
        return NULL;
    }
    const Race *race = &((Game *)self)->race;
    const Wheel *wheel = &race->wheels[i];
    return Py_BuildValue("ddddddi", wheel->omega, wheel->phase, wheel->gas, wheel->brake, wheel->steer,
                         (double)joint_angle(&race->island.joints[i], race->island.bodies), wheel->tiles);
}

/* tiles(): a byte for each: bits 0 to 3 for the wheels upon it, 4 visited, 5 in the road's plain colour */
static PyObject *game_tiles(PyObject *self, PyObject *none)
{
    (void)none;
    const Race *race = &((Game *)self)->race;
    PyObject *bytes = PyBytes_FromStringAndSize(NULL, race->tile_count);
    char *flags = bytes ? PyBytes_AsString(bytes) : NULL;
    for (int i = 0; flags && i < race->tile_count; i++) {
        const Tile *tile = &race->tiles[i];
        flags[i] = (char)(tile->touching >> FIXTURES | tile->visited << 4 | tile->plain << 5);
    }
    return bytes;
}

/* contacts(): the newest first, of each the tile, the fixture that moves (the hull's four, then the wheels), and
   whether the tile is the first of the two; they show the boxes, their tree and its numbers */
static PyObject *game_contacts(PyObject *self, PyObject *none)
{
    (void)none;
    Race *race = &((Game *)self)->race;
    PyObject *list = PyList_New(0);
    for (int i = race->contact_count - 1; list && i >= 0; i--) {
        Contact contact = race->contacts[i];
        bool first = race->tiles[contact.tile].leaf < mover_fixture(race, contact.mover)->leaf;
        PyObject *entry = Py_BuildValue("iiO", contact.tile, contact.mover, first ? Py_True : Py_False);
        if (!entry || PyList_Append(list, entry) < 0)
            Py_CLEAR(list);
        Py_XDECREF(entry);
    }
    return list;
}

/* score(): reward so far, seconds, tiles visited, whether a new lap began */
static PyObject *game_score(PyObject *self, PyObject *none)
{
    (void)none;
    const Race *race = &((Game *)self)->race;
    return Py_BuildValue("ddiO", race->reward, race->time, race->visited, race->new_lap ? Py_True : Py_False);
}

static PyMethodDef methods[] = {
    {"reset", game_reset, METH_VARARGS, "A new episode."},
    {"step", game_step, METH_VARARGS, "A step of the car."},
    {"body", game_body, METH_O, "Where a wheel (0 to 3) or the hull (4) is, and how it moves."},
    {"wheel", game_wheel, METH_O, "How a wheel turns, and on how many tiles it stands."},
    {"tiles", game_tiles, METH_NOARGS, "What has touched each tile."},
    {"contacts", game_contacts, METH_NOARGS, "Tiles and fixtures whose boxes meet."},
    {"score", game_score, METH_NOARGS, "What was reached."},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot slots[] = {
    {Py_tp_new, game_new},
    {Py_tp_dealloc, game_free},
    {Py_tp_methods, methods},
    {0, NULL},
};

static PyType_Spec spec = {"dreamfleet.worker.worlds.car_racing._native.Race", sizeof(Game), 0, Py_TPFLAGS_DEFAULT,
                           slots};

PyObject *game_type(void)
{
    return PyType_FromSpec(&spec);
}
