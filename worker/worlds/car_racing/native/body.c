/* Box2D's bodies and contacts for Python, read where they lie: its Python objects take a call for each number.

   `knows` tells whether they lie as is assumed here; it follows a pointer only after Box2D has given the same one. */

#include "body.h"

#define NAMES(each)                                                                                                    \
    each(__dict__) each(angle) each(angularVelocity) each(body) each(color) each(env) each(fixtureA) each(fixtureB)    \
        each(hull) each(idx) each(lap_complete_percent) each(linearVelocity) each(new_lap) each(phase) each(position)  \
            each(reward) each(road_color) each(road_friction) each(road_visited) each(this) each(tile_visited_count)   \
                each(tiles) each(track) each(userData) each(wheels) each(x) each(y)

#define INDEX(name) NAME_##name,
#define TEXT(name) #name,
enum { NAMES(INDEX) NAME_COUNT };
static const char *const texts[] = {NAMES(TEXT)};
static PyObject *names[NAME_COUNT], *whole;
#define NAME(name) names[NAME_##name]

/* b2Fixture and b2Contact, up to the last field that is read. */
typedef struct {
    float density;
    void *next;
    const Body *body;
} Fixture;

typedef struct {
    void *methods;
    uint32_t flags;
    void *before, *after, *nodes[2][4];
    const Fixture *sides[2];
} Contact;

bool body_init(void)
{
    for (int i = 0; i < NAME_COUNT; i++)
        if (!(names[i] = PyUnicode_InternFromString(texts[i])))
            return false;
    return (whole = PySlice_New(NULL, NULL, NULL));
}

bool get(PyObject *object, PyObject *name, double *value)
{
    PyObject *found = PyObject_GetAttr(object, name);
    if (!found)
        return false;
    *value = PyFloat_AsDouble(found);
    Py_DECREF(found);
    return *value != -1.0 || !PyErr_Occurred();
}

bool set(PyObject *object, PyObject *name, double value)
{
    PyObject *number = PyFloat_FromDouble(value);
    bool done = number && PyObject_SetAttr(object, name, number) == 0;
    Py_XDECREF(number);
    return done;
}

/* What SWIG's object points to. */
static const void *pointer_of(PyObject *object)
{
    PyObject *swig = PyObject_GetAttr(object, NAME(this)), *number = swig ? PyNumber_Long(swig) : NULL;
    const void *pointer = number ? PyLong_AsVoidPtr(number) : NULL;
    Py_XDECREF(swig);
    Py_XDECREF(number);
    if (!pointer && !PyErr_Occurred())
        PyErr_SetString(PyExc_ValueError, "a destroyed body");
    return pointer;
}

const Body *body_of(PyObject *object)
{
    return pointer_of(object);
}

/* ---- whether they lie so ---- */

static bool is(PyObject *object, PyObject *name, float value)
{
    double told;
    return get(object, name, &told) && told == (double)value;
}

static bool is_pair(PyObject *object, PyObject *name, float x, float y)
{
    PyObject *pair = PyObject_GetAttr(object, name);
    bool same = pair && is(pair, NAME(x), x) && is(pair, NAME(y), y);
    Py_XDECREF(pair);
    return same;
}

static bool knows_body(PyObject *object, const Body *body)
{
    PyObject *user = PyObject_GetAttr(object, NAME(userData));
    bool known = user && body_of(object) == body && body->user == user && is(object, NAME(angle), body->angle) &&
                 is(object, NAME(angularVelocity), body->spin) &&
                 is_pair(object, NAME(position), body->x, body->y) &&
                 is_pair(object, NAME(linearVelocity), body->vx, body->vy);
    Py_XDECREF(user);
    return known;
}

PyObject *knows(PyObject *self, PyObject *object)
{
    (void)self;
    const Contact *contact = pointer_of(object);
    bool known = contact;
    for (int side = 0; known && side < 2; side++) {
        PyObject *fixture = PyObject_GetAttr(object, side ? NAME(fixtureB) : NAME(fixtureA));
        PyObject *body = fixture ? PyObject_GetAttr(fixture, NAME(body)) : NULL;
        known = body && pointer_of(fixture) == contact->sides[side] && knows_body(body, contact->sides[side]->body);
        Py_XDECREF(fixture);
        Py_XDECREF(body);
    }
    return PyErr_Occurred() ? NULL : PyBool_FromLong(known);
}

/* ---- where the car is ---- */

enum { WHEELS = 4, STATE = 4 };

PyObject *look(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *car;
    Py_buffer out;
    if (!PyArg_ParseTuple(args, "w*O", &out, &car))
        return NULL;
    PyObject *wheels = PyObject_GetAttr(car, NAME(wheels)), *hull = PyObject_GetAttr(car, NAME(hull));
    double *state = out.buf;
    bool done = wheels && hull && PyList_Check(wheels) && PyList_Size(wheels) == WHEELS &&
                out.len == (WHEELS + 1) * STATE * (Py_ssize_t)sizeof(double);
    if (!done && !PyErr_Occurred())
        PyErr_SetString(PyExc_ValueError, "a car has a hull and four wheels");
    for (int i = 0; done && i <= WHEELS; i++, state += STATE) {
        PyObject *each = i < WHEELS ? PySequence_GetItem(wheels, i) : Py_NewRef(hull);
        const Body *body = each ? body_of(each) : NULL;
        done = body && (each == hull || get(each, NAME(phase), &state[3]));
        if (done) {
            state[0] = body->x;
            state[1] = body->y;
            state[2] = body->angle;
        }
        Py_XDECREF(each);
    }
    Py_XDECREF(wheels);
    Py_XDECREF(hull);
    PyBuffer_Release(&out);
    return done ? Py_NewRef(Py_None) : NULL;
}

/* ---- wheels on tiles ---- */

static bool has(PyObject *object, PyObject *name)
{
    PyObject *attributes = object && object != Py_None ? PyObject_GetAttr(object, NAME(__dict__)) : NULL;
    bool found = attributes && PyDict_Contains(attributes, name) == 1;
    Py_XDECREF(attributes);
    return found;
}

static bool paint(PyObject *tile, PyObject *environment)
{
    PyObject *colour = PyObject_GetAttr(tile, NAME(color)), *road = PyObject_GetAttr(environment, NAME(road_color));
    bool done = colour && road && PyObject_SetItem(colour, whole, road) == 0;
    Py_XDECREF(colour);
    Py_XDECREF(road);
    return done;
}

/* A tile that no wheel has touched before. */
static bool visit(PyObject *listener, PyObject *environment, PyObject *tile)
{
    PyObject *track = PyObject_GetAttr(environment, NAME(track));
    Py_ssize_t tiles = track ? PyObject_Size(track) : -1;
    Py_XDECREF(track);
    double reward, visited, index, enough;
    if (tiles == 0)
        PyErr_SetString(PyExc_ZeroDivisionError, "a track without tiles");
    if (tiles <= 0 || !get(environment, NAME(reward), &reward) || !get(tile, NAME(idx), &index) ||
        !get(environment, NAME(tile_visited_count), &visited) || !get(listener, NAME(lap_complete_percent), &enough))
        return false;
    PyObject *count = PyLong_FromDouble(++visited);
    bool done = count && PyObject_SetAttr(tile, NAME(road_visited), Py_True) == 0 &&
                set(environment, NAME(reward), reward + 1000.0 / (double)tiles) &&
                PyObject_SetAttr(environment, NAME(tile_visited_count), count) == 0;
    Py_XDECREF(count);
    if (done && index == 0 && visited / (double)tiles > enough)
        return PyObject_SetAttr(environment, NAME(new_lap), Py_True) == 0;
    return done;
}

static bool enter(PyObject *listener, PyObject *environment, PyObject *tile, PyObject *tiles)
{
    PyObject *visited = PySet_Add(tiles, tile) == 0 ? PyObject_GetAttr(tile, NAME(road_visited)) : NULL;
    int before = visited ? PyObject_IsTrue(visited) : -1;
    Py_XDECREF(visited);
    return before == 1 || (before == 0 && visit(listener, environment, tile));
}

static bool leave(PyObject *tile, PyObject *tiles)
{
    int found = PySet_Discard(tiles, tile);
    if (found == 0)
        PyErr_SetObject(PyExc_KeyError, tile);
    return found == 1;
}

static bool meet(PyObject *listener, PyObject *tile, PyObject *other, bool begin)
{
    PyObject *environment = PyObject_GetAttr(listener, NAME(env)), *tiles = NULL;
    bool done = environment && paint(tile, environment);
    if (done && has(other, NAME(tiles))) {
        tiles = PyObject_GetAttr(other, NAME(tiles));
        done = tiles && (begin ? enter(listener, environment, tile, tiles) : leave(tile, tiles));
    }
    Py_XDECREF(environment);
    Py_XDECREF(tiles);
    return done;
}

PyObject *touch(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *listener, *object;
    int begin;
    if (!PyArg_ParseTuple(args, "OOp", &listener, &object, &begin))
        return NULL;
    const Contact *contact = pointer_of(object);
    if (!contact)
        return NULL;
    PyObject *first = contact->sides[0]->body->user, *second = contact->sides[1]->body->user;
    PyObject *tile = has(second, NAME(road_friction)) ? second : has(first, NAME(road_friction)) ? first : NULL;
    if (!tile || meet(listener, tile, tile == second ? first : second, begin))
        return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
    return NULL;
}
