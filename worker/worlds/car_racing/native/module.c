/* CarRacing's picture for Python: `scene`, `bar`, `picture` and `widen`, with `roll` of roll.c, and `knows`, `look` and
   `touch` of body.c. Arrays come as buffers of doubles.

   One canvas a process, whatever the number of environments: it is rebuilt for every picture, and the interpreter
   lock is held throughout. */

#include "roll.h"

#include "body.h"
#include "canvas.h"
#include "game.h"

#include <math.h>
#include <string.h>

enum { BODIES = 5, BODY = 4, VIEW = 5, MAX_VERTICES = 8 };

static Canvas canvas;

/* ---- geometry, in double precision and in gymnasium's order of operations ---- */

typedef struct {
    double x, y;
} Vector;

typedef struct {
    double sine, cosine, zoom;
    Vector shift;
    int quarter; /* turns by a multiple of 90 degrees, which pygame makes exact; or -1 */
} View;

static const double EPSILON = 1e-6; /* pygame's Vector2 */
static const double QUARTER = 1.57079632679489661923;

static View view_of(double zoom, double angle, Vector hull)
{
    View view = {.zoom = zoom, .quarter = -1};
    angle = fmod(angle, 4 * QUARTER);
    if (angle < 0)
        angle += 4 * QUARTER;
    if (fmod(angle + EPSILON, QUARTER) < 2 * EPSILON)
        view.quarter = (int)((angle + EPSILON) / QUARTER) % 4;
    view.sine = sin(angle);
    view.cosine = cos(angle);
    view.shift = hull;
    return view;
}

static Vector rotate(const View *view, Vector v)
{
    switch (view->quarter) {
    case 0:
        return v;
    case 1:
        return (Vector){-v.y, v.x};
    case 2:
        return (Vector){-v.x, -v.y};
    case 3:
        return (Vector){v.y, -v.x};
    default:
        return (Vector){view->cosine * v.x - view->sine * v.y, view->sine * v.x + view->cosine * v.y};
    }
}

static Vector project(const View *view, Vector v)
{
    Vector turned = rotate(view, v);
    return (Vector){turned.x * view->zoom + view->shift.x, turned.y * view->zoom + view->shift.y};
}

static int16_t short_of(double value)
{
    return (int16_t)(long)value;
}

/* A quadrilateral of the ground, if any of it can be seen: the first corner decides, for no side is longer. */
static void quadrilateral(const View *view, const double *corners, double reach, uint32_t colour)
{
    Vector first = project(view, (Vector){corners[0], corners[1]});
    if (first.x < -reach || first.x > WIDTH + reach || first.y < -reach || first.y > HEIGHT + reach)
        return;
    Point points[4];
    int left = 0, right = 0, low = 0, high = 0;
    for (int i = 0; i < 4; i++) {
        Vector p = i ? project(view, (Vector){corners[2 * i], corners[2 * i + 1]}) : first;
        points[i] = (Point){short_of(p.x), short_of(p.y)};
        left += points[i].x < 0;
        right += points[i].x > WIDTH - 1;
        low += points[i].y < HEIGHT - SCENE - 1;
        high += points[i].y > HEIGHT - 1;
    }
    if (left == 4 || right == 4 || low == 4 || high == 4)
        return;
    canvas_polygon(&canvas, points, 4, colour);
}

/* Whether a first corner may be near enough to be seen: cheaper than to project it. */
static inline bool is_within(const double *corner, Vector hull, double far)
{
    double x = corner[0] - hull.x, y = corner[1] - hull.y;
    return x * x + y * y <= far * far;
}

static uint32_t colour_of(const double *rgb)
{
    return ((uint32_t)rgb[0] & 255) << 16 | ((uint32_t)rgb[1] & 255) << 8 | ((uint32_t)rgb[2] & 255);
}

/* Whether the whole screen lies inside the field, with some pixels to spare. */
static bool field_covers(const View *view, double bounds)
{
    double spare = 8 / view->zoom;
    for (int corner = 0; corner < 4; corner++) {
        double x = ((corner & 1 ? WIDTH : 0) - view->shift.x) / view->zoom;
        double y = ((corner & 2 ? HEIGHT : 0) - view->shift.y) / view->zoom;
        double back_x = view->cosine * x + view->sine * y, back_y = view->cosine * y - view->sine * x;
        if (fabs(back_x) > bounds - spare || fabs(back_y) > bounds - spare)
            return false;
    }
    return true;
}

/* ---- the car: Box2D's transform in single precision, then the view ---- */

typedef struct {
    float x, y, sine, cosine;
} Transform;

static void car_polygon(const View *view, Transform at, const double *vertices, int count, uint32_t colour)
{
    int x[MAX_VERTICES], y[MAX_VERTICES];
    for (int i = 0; i < count; i++) {
        float local_x = (float)vertices[2 * i], local_y = (float)vertices[2 * i + 1];
        float world_x = (at.cosine * local_x - at.sine * local_y) + at.x;
        float world_y = (at.sine * local_x + at.cosine * local_y) + at.y;
        Vector p = project(view, (Vector){world_x, world_y});
        x[i] = (int)p.x;
        y[i] = (int)p.y;
    }
    canvas_solid(&canvas, x, y, count, colour, false);
}

static double sign(double value)
{
    return (value > 0) - (value < 0);
}

/* The light stripe that shows a wheel turning. `half` are half its width and its radius, of the tyre. */
static void stripe(const View *view, Transform at, double phase, const double *wheel)
{
    double first = phase, second = phase + 1.2;
    double sine_1 = sin(first), sine_2 = sin(second), cosine_1 = cos(first), cosine_2 = cos(second);
    if (sine_1 > 0 && sine_2 > 0)
        return;
    if (sine_1 > 0)
        cosine_1 = sign(cosine_1);
    if (sine_2 > 0)
        cosine_2 = sign(cosine_2);
    double width = wheel[0] * wheel[2], near = wheel[1] * cosine_1 * wheel[2], far = wheel[1] * cosine_2 * wheel[2];
    double corners[8] = {-width, near, width, near, width, far, -width, far};
    car_polygon(view, at, corners, 4, colour_of(wheel + 3));
}

/* Fixtures: body, red, green, blue, count, then the vertices, and so on. */
static bool draw_car(const View *view, const double *bodies, const double *fixtures, Py_ssize_t length,
                     const double *wheel)
{
    Transform at[BODIES];
    for (int i = 0; i < BODIES; i++) {
        const double *body = bodies + BODY * i;
        float angle = (float)body[2];
        at[i] = (Transform){(float)body[0], (float)body[1], sinf(angle), cosf(angle)};
    }
    for (Py_ssize_t i = 0; i + 5 <= length;) {
        int body = (int)fixtures[i], count = (int)fixtures[i + 4];
        if (body < 0 || body >= BODIES || count < 3 || count > MAX_VERTICES || i + 5 + 2 * count > length)
            return false;
        car_polygon(view, at[body], fixtures + i + 5, count, colour_of(fixtures + i + 1));
        if (body < BODIES - 1)
            stripe(view, at[body], bodies[BODY * body + 3], wheel);
        i += 5 + 2 * count;
    }
    return true;
}

/* ---- Python ---- */

typedef struct {
    Py_buffer buffer;
    const double *values;
    Py_ssize_t length;
} Doubles;

static void release(Doubles *arrays, int count)
{
    for (int i = 0; i < count; i++)
        PyBuffer_Release(&arrays[i].buffer);
}

static bool fail(const char *what)
{
    PyErr_SetString(PyExc_ValueError, what);
    return false;
}

/* Nothing that drives gets near this; beyond it, pixels could not be counted in whole numbers. */
static bool near(double value)
{
    return fabs(value) <= 1e5;
}

static bool is_sound(const double *sight, const double *bodies)
{
    for (int i = 0; i < BODIES; i++, bodies += BODY)
        if (!near(bodies[0]) || !near(bodies[1]) || !isfinite(bodies[2]) || !isfinite(bodies[3]))
            return false;
    return sight[0] > 0 && sight[0] < 100 && isfinite(sight[1]) && near(sight[2]) && near(sight[3]) && near(sight[4]);
}

enum { ROAD, ROAD_COLOURS, GRASS, PALETTE, SIGHT, BODY_STATE, FIXTURES, WHEEL, ARRAYS };

/* The scene's cells, or why not. */
static bool draw_scene(Doubles *in, uint8_t *out)
{
    for (int i = 0; i < ARRAYS; i++) {
        in[i].values = in[i].buffer.buf;
        in[i].length = in[i].buffer.len / (Py_ssize_t)sizeof(double);
    }
    Py_ssize_t roads = in[ROAD].length / 8;
    if (in[ROAD_COLOURS].length != 3 * roads || in[PALETTE].length != 6 || in[SIGHT].length != VIEW ||
        in[BODY_STATE].length != BODIES * BODY || in[WHEEL].length != 6)
        return fail("arrays of wrong sizes");
    const double *sight = in[SIGHT].values; /* zoom, angle, hull x, hull y, the field's half side */
    if (!is_sound(sight, in[BODY_STATE].values))
        return fail("the car's state is not finite, or it is too far away to be drawn");
    View view = view_of(sight[0], sight[1], (Vector){0, 0});
    Vector scroll = rotate(&view, (Vector){-sight[2] * sight[0], -sight[3] * sight[0]});
    view.shift = (Vector){WIDTH / 2.0 + scroll.x, HEIGHT / 4.0 + scroll.y};

    uint32_t ground = colour_of(in[PALETTE].values), patch = colour_of(in[PALETTE].values + 3);
    double bounds = sight[4], reach = bounds / 20 * sqrt(2) * sight[0] + 2;
    bool covered = field_covers(&view, bounds);
    uint32_t background = covered ? ground : 0;
    canvas_begin(&canvas, 0, SCENE - 1);
    if (!covered) {
        double corners[8] = {bounds, bounds, bounds, -bounds, -bounds, -bounds, -bounds, bounds};
        quadrilateral(&view, corners, INFINITY, ground);
    }
    Vector hull = {sight[2], sight[3]};
    double far = hypot(WIDTH / 2.0 + reach, HEIGHT * 3 / 4.0 + reach) / sight[0] + 1; /* the hull is at (1/2, 1/4) */
    for (Py_ssize_t i = 0; i + 8 <= in[GRASS].length; i += 8)
        if (is_within(in[GRASS].values + i, hull, far))
            quadrilateral(&view, in[GRASS].values + i, reach, patch);
    for (Py_ssize_t i = 0; i < roads; i++)
        if (is_within(in[ROAD].values + 8 * i, hull, far))
            quadrilateral(&view, in[ROAD].values + 8 * i, reach, colour_of(in[ROAD_COLOURS].values + 3 * i));
    if (!draw_car(&view, in[BODY_STATE].values, in[FIXTURES].values, in[FIXTURES].length, in[WHEEL].values))
        return fail("damaged fixtures");
    if (canvas.overflow)
        return fail("more is drawn than there is room for");
    canvas_finish(&canvas, background, 0, SCENE_ROWS, out);
    return true;
}

static PyObject *scene(PyObject *self, PyObject *args)
{
    (void)self;
    Py_buffer out;
    Doubles in[ARRAYS];
    if (!PyArg_ParseTuple(args, "w*y*y*y*y*y*y*y*y*", &out, &in[0].buffer, &in[1].buffer, &in[2].buffer,
                          &in[3].buffer, &in[4].buffer, &in[5].buffer, &in[6].buffer, &in[7].buffer))
        return NULL;
    bool drawn = out.len >= SCENE_ROWS * CELLS * 3 ? draw_scene(in, out.buf) : fail("the picture is too small");
    release(in, ARRAYS);
    PyBuffer_Release(&out);
    return drawn ? Py_NewRef(Py_None) : NULL;
}

/* An indicator: a rectangle from (x, y) to (u, v), given as gymnasium gives its corners. */
static void indicator(double value, double x, double y, double u, double v, uint32_t colour)
{
    if (!(fabs(value) > 1e-4 && near(value)))
        return;
    int left = (int)x, top = (int)y, right = (int)u, bottom = (int)v;
    int upright_x[4] = {left, right, right, left}, upright_y[4] = {top, top, bottom, bottom};
    canvas_solid(&canvas, upright_x, upright_y, 4, colour, true);
}

static void upright(double place, double level, double value, uint32_t colour)
{
    double s = WIDTH / 40.0, h = HEIGHT / 40.0;
    indicator(value, place * s, HEIGHT - (h + h * level), (place + 1) * s, HEIGHT - h, colour);
}

static void level(double place, double length, double value, uint32_t colour)
{
    double s = WIDTH / 40.0, h = HEIGHT / 40.0;
    indicator(value, (place + 0) * s, HEIGHT - 4 * h, (place + length) * s, HEIGHT - 2 * h, colour);
}

/* bar(out, speed, omega 0 to 3, steering, spin): the 12 rows of the indicator bar, without the score's text. */
static PyObject *bar(PyObject *self, PyObject *args)
{
    (void)self;
    Py_buffer out;
    double speed, omega[4], steering, spin;
    if (!PyArg_ParseTuple(args, "w*ddddddd", &out, &speed, &omega[0], &omega[1], &omega[2], &omega[3], &steering,
                          &spin))
        return NULL;
    bool fits = out.len >= (CELLS - SCENE_ROWS) * CELLS * 3;
    if (fits) {
        canvas_begin(&canvas, SCENE, HEIGHT - 1);
        upright(5, 0.02 * speed, speed, 0xffffff);
        upright(7, 0.01 * omega[0], omega[0], 0x0000ff);
        upright(8, 0.01 * omega[1], omega[1], 0x0000ff);
        upright(9, 0.01 * omega[2], omega[2], 0x3300ff);
        upright(10, 0.01 * omega[3], omega[3], 0x3300ff);
        level(20, -10.0 * steering, steering, 0x00ff00);
        level(30, -0.8 * spin, spin, 0xff0000);
        canvas_finish(&canvas, 0, SCENE_ROWS, CELLS, out.buf);
    }
    PyBuffer_Release(&out);
    return fits ? Py_NewRef(Py_None) : (fail("the picture is too small"), NULL);
}

/* picture(out, observation): the 64x64 picture of 84 or more rows of an observation, as worker.worlds.car_racing.preprocessing. */
static PyObject *picture(PyObject *self, PyObject *args)
{
    (void)self;
    Py_buffer out, in;
    if (!PyArg_ParseTuple(args, "w*y*", &out, &in))
        return NULL;
    bool fits = out.len == SMALL * SMALL * 3 && in.len >= SCENE_ROWS * CELLS * 3;
    if (fits)
        canvas_shrink(in.buf, out.buf);
    PyBuffer_Release(&in);
    PyBuffer_Release(&out);
    return fits ? Py_NewRef(Py_None) : (fail("pictures of wrong sizes"), NULL);
}

/* widen(most): how wide the instructions are that draw from now on, as canvas_widen; they change no bit. */
static PyObject *widen(PyObject *self, PyObject *most)
{
    (void)self;
    long wanted = PyLong_AsLong(most);
    return wanted == -1 && PyErr_Occurred() ? NULL : PyLong_FromLong(canvas_widen((int)wanted));
}

static PyMethodDef methods[] = {
    {"scene", scene, METH_VARARGS, "Draw the 84 rows of cells above the bar."},
    {"bar", bar, METH_VARARGS, "Draw the bar's 12 rows without its text."},
    {"picture", picture, METH_VARARGS, "The 64x64 picture of an observation's scene."},
    {"roll", roll, METH_VARARGS, "A step of the car's wheels."},
    {"knows", knows, METH_O, "Whether Box2D's contacts and bodies lie in memory as is assumed here."},
    {"look", look, METH_VARARGS, "Where the wheels and the hull are."},
    {"touch", touch, METH_VARARGS, "What a contact changes of tiles, wheels and reward."},
    {"widen", widen, METH_O, "Draw with instructions at most so wide: 0 plain, 1 AVX2, 2 AVX-512; say with which."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_native", "CarRacing's picture.", -1, methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__native(void)
{
    canvas_init(&canvas);
    if (!roll_init() || !body_init())
        return NULL;
    PyObject *module = PyModule_Create(&definition), *race = module ? game_type() : NULL;
    if (race && PyModule_AddObjectRef(module, "Race", race) == 0) {
        Py_DECREF(race);
        return module;
    }
    Py_XDECREF(race);
    Py_XDECREF(module);
    return NULL;
}
