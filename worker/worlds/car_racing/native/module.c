/* CarRacing for Python: `Race`, and `widen` of how it is drawn. The interpreter's lock is held throughout. */

#define Py_LIMITED_API 0x030b0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "scene.h"

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

static Race *race_of(PyObject *self)
{
    Race *race = &((Game *)self)->race;
    if (race->tile_count)
        return race;
    PyErr_SetString(PyExc_ValueError, "an episode begins with a reset");
    return NULL;
}

/* reset(draws, lap_complete_percent, colours): whether the draws gave a track; without one the episode goes on */
static PyObject *game_reset(PyObject *self, PyObject *args)
{
    Py_buffer draws, colours;
    double share;
    if (!PyArg_ParseTuple(args, "y*dy*", &draws, &share, &colours))
        return NULL;
    Beginning began = NO_TRACK;
    if (draws.len != DRAWS * sizeof(double) || colours.len != 9 * sizeof(double) || !all_finite(draws.buf, DRAWS) ||
        !all_finite(colours.buf, 9))
        PyErr_SetString(PyExc_ValueError, "a reset takes 24 draws and three colours, in doubles, all finite");
    else if ((began = race_reset(&((Game *)self)->race, draws.buf, share, colours.buf)) == NO_MEMORY)
        PyErr_NoMemory();
    PyBuffer_Release(&draws);
    PyBuffer_Release(&colours);
    return PyErr_Occurred() ? NULL : PyBool_FromLong(began == BEGUN);
}

/* step(steering, gas, brake): the reward, and whether a lap was finished; None as long as the episode goes on */
static PyObject *game_step(PyObject *self, PyObject *args)
{
    double action[3];
    Race *race = race_of(self);
    if (!race || !PyArg_ParseTuple(args, "ddd", &action[0], &action[1], &action[2]))
        return NULL;
    if (!all_finite(action, 3)) {
        PyErr_SetString(PyExc_ValueError, "an action is three finite numbers");
        return NULL;
    }
    Outcome outcome = race_step(race, action[0], action[1], action[2]);
    PyObject *end = outcome.end == GOES_ON ? Py_None : outcome.end == LAP_FINISHED ? Py_True : Py_False;
    return Py_BuildValue("dO", outcome.reward, end);
}

static PyObject *game_idle(PyObject *self, PyObject *none)
{
    (void)none;
    Race *race = race_of(self);
    if (!race)
        return NULL;
    race_idle(race);
    return Py_NewRef(Py_None);
}

static const double FURTHEST = 1e6; /* where single precision still separates tiles */

/* place(angle, x, y) */
static PyObject *game_place(PyObject *self, PyObject *args)
{
    double at[3];
    Race *race = race_of(self);
    if (!race || !PyArg_ParseTuple(args, "ddd", &at[0], &at[1], &at[2]))
        return NULL;
    if (!(fabs(at[0]) <= FURTHEST && fabs(at[1]) <= FURTHEST && fabs(at[2]) <= FURTHEST)) {
        PyErr_SetString(PyExc_ValueError, "a place is three numbers of at most a million");
        return NULL;
    }
    race_place(race, at[0], at[1], at[2]);
    return Py_NewRef(Py_None);
}

/* draw(out): the observation or the small picture, as large as `out` is */
static PyObject *game_draw(PyObject *self, PyObject *args)
{
    Py_buffer out;
    const Race *race = race_of(self);
    if (!race || !PyArg_ParseTuple(args, "w*", &out))
        return NULL;
    bool small = out.len == SMALL_PICTURE * SMALL_PICTURE * 3, fits = small || out.len == PICTURE * PICTURE * 3;
    if (!fits)
        PyErr_SetString(PyExc_ValueError, "a picture is 96x96x3 or 64x64x3 bytes");
    else if (!(small ? scene_draw_small : scene_draw)(race, out.buf))
        PyErr_SetString(PyExc_ValueError, "the car's state is not finite, or it is too far away to be drawn");
    PyBuffer_Release(&out);
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
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

static PyObject *doubles(const double *values, Py_ssize_t count)
{
    PyObject *tuple = PyTuple_New(count);
    for (Py_ssize_t i = 0; tuple && i < count; i++) {
        PyObject *number = PyFloat_FromDouble(values[i]);
        if (!number || PyTuple_SetItem(tuple, i, number) < 0)
            Py_CLEAR(tuple);
    }
    return tuple;
}

/* track(): alpha, heading, x and y of each point, as gymnasium's */
static PyObject *game_track(PyObject *self, PyObject *none)
{
    (void)none;
    const Track *track = &((Game *)self)->race.track;
    PyObject *list = PyList_New(track->count);
    for (int i = 0; list && i < track->count; i++) {
        PyObject *point = doubles(&track->points[i].alpha, 4);
        if (!point || PyList_SetItem(list, i, point) < 0)
            Py_CLEAR(list);
    }
    return list;
}

/* road(): of each polygon, in the order in which they are drawn, the corners in one row, its tile, whether a border */
static PyObject *game_road(PyObject *self, PyObject *none)
{
    (void)none;
    const Track *track = &((Game *)self)->race.track;
    PyObject *list = PyList_New(track->quad_count);
    for (int i = 0; list && i < track->quad_count; i++) {
        const Quad *quad = &track->quads[i];
        PyObject *entry = Py_BuildValue("NiO", doubles(&quad->corners[0].x, 2 * TILE_CORNERS), quad->tile,
                                        quad->border ? Py_True : Py_False);
        if (!entry || PyList_SetItem(list, i, entry) < 0)
            Py_CLEAR(list);
    }
    return list;
}

static PyObject *game_time(PyObject *self, void *none)
{
    (void)none;
    return PyFloat_FromDouble(((Game *)self)->race.time);
}

static int game_set_time(PyObject *self, PyObject *value, void *none)
{
    (void)none;
    double time = value ? PyFloat_AsDouble(value) : -1.0;
    if (!PyErr_Occurred() && !(time >= 0 && isfinite(time)))
        PyErr_SetString(PyExc_ValueError, "a time is finite and not below 0");
    if (PyErr_Occurred())
        return -1;
    ((Game *)self)->race.time = time;
    return 0;
}

static PyObject *game_shown(PyObject *self, void *none)
{
    (void)none;
    return PyFloat_FromDouble(((Game *)self)->race.shown);
}

static PyMethodDef methods[] = {
    {"reset", game_reset, METH_VARARGS, "A new episode."},
    {"step", game_step, METH_VARARGS, "A step of the car."},
    {"idle", game_idle, METH_NOARGS, "A step without an action."},
    {"place", game_place, METH_VARARGS, "A new car at an angle and a place."},
    {"draw", game_draw, METH_VARARGS, "The picture, but for the score's text."},
    {"body", game_body, METH_O, "Where a wheel (0 to 3) or the hull (4) is, and how it moves."},
    {"wheel", game_wheel, METH_O, "How a wheel turns, and on how many tiles it stands."},
    {"tiles", game_tiles, METH_NOARGS, "What has touched each tile."},
    {"contacts", game_contacts, METH_NOARGS, "Tiles and fixtures whose boxes meet."},
    {"score", game_score, METH_NOARGS, "What was reached."},
    {"track", game_track, METH_NOARGS, "The centre line."},
    {"road", game_road, METH_NOARGS, "The road's polygons."},
    {NULL, NULL, 0, NULL},
};

static PyGetSetDef attributes[] = {
    {"time", game_time, game_set_time, "Seconds since the reset; the picture zooms in during the first.", NULL},
    {"shown", game_shown, NULL, "The reward that the picture shows, before the last step's time is paid.", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

static PyType_Slot slots[] = {
    {Py_tp_new, game_new},
    {Py_tp_dealloc, game_free},
    {Py_tp_methods, methods},
    {Py_tp_getset, attributes},
    {0, NULL},
};

static PyType_Spec spec = {"dreamfleet.worker.worlds.car_racing._native.Race", sizeof(Game), 0, Py_TPFLAGS_DEFAULT,
                           slots};

/* widen(most): how wide the instructions are that draw from now on; they change no bit */
static PyObject *widen(PyObject *self, PyObject *most)
{
    (void)self;
    long wanted = PyLong_AsLong(most);
    return wanted == -1 && PyErr_Occurred() ? NULL : PyLong_FromLong(scene_widen((int)wanted));
}

static PyMethodDef functions[] = {
    {"widen", widen, METH_O, "Draw with instructions at most so wide: 0 plain, 1 AVX2, 2 AVX-512; say with which."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_native", "CarRacing.", -1, functions, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__native(void)
{
    scene_init();
    PyObject *module = PyModule_Create(&definition), *race = module ? PyType_FromSpec(&spec) : NULL;
    if (race && PyModule_AddObjectRef(module, "Race", race) == 0) {
        Py_DECREF(race);
        return module;
    }
    Py_XDECREF(race);
    Py_XDECREF(module);
    return NULL;
}
