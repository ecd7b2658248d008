/* A step of the car's four wheels: gymnasium's arithmetic in the same order, in double precision.

   What Box2D is told goes through its Python objects; the state of its bodies is read where it lies. */

#include "roll.h"

#include "body.h"

#include <math.h>
#include <stdbool.h>

#define NAMES(each)                                                                                                    \
    each(angle) each(ApplyForceToCenter) each(brake) each(fuel_spent) each(gas) each(joint) each(motorSpeed)           \
        each(omega) each(phase) each(road_friction) each(skid) each(skid_particle) each(skid_start) each(steer)        \
            each(tiles) each(wheel_rad) each(wheels)

#define INDEX(name) NAME_##name,
#define TEXT(name) #name,
enum { NAMES(INDEX) NAME_COUNT };
static const char *const texts[] = {NAMES(TEXT)};
static PyObject *names[NAME_COUNT];
#define NAME(name) names[NAME_##name]

/* What gymnasium's module says of the car. */
typedef struct {
    double dt, stiffness, engine, inertia, road;
} Constants;

bool roll_init(void)
{
    for (int i = 0; i < NAME_COUNT; i++)
        if (!(names[i] = PyUnicode_InternFromString(texts[i])))
            return false;
    return true;
}

static double sign(double value)
{
    return (value > 0) - (value < 0);
}

/* Turns the wheel towards where it is steered. */
static bool steer(PyObject *wheel)
{
    PyObject *joint = PyObject_GetAttr(wheel, NAME(joint));
    double wanted, angle;
    bool done = joint && get(wheel, NAME(steer), &wanted) && get(joint, NAME(angle), &angle);
    if (done) {
        double turn = wanted - angle;
        done = set(joint, NAME(motorSpeed), sign(turn) * fmin(50.0 * fabs(turn), 3.0));
    }
    Py_XDECREF(joint);
    return done;
}

/* The grip of what the wheel stands on: the best of its tiles, or grass. */
static bool grip(PyObject *wheel, double road, double *limit, bool *grass)
{
    PyObject *tiles = PyObject_GetAttr(wheel, NAME(tiles)), *all = tiles ? PyObject_GetIter(tiles) : NULL, *tile;
    *limit = road * 0.6;
    *grass = true;
    Py_XDECREF(tiles);
    if (!all)
        return false;
    while ((tile = PyIter_Next(all))) {
        double friction;
        bool found = get(tile, NAME(road_friction), &friction);
        Py_DECREF(tile);
        if (!found)
            break;
        *limit = fmax(*limit, road * friction);
        *grass = false;
    }
    Py_DECREF(all);
    return !PyErr_Occurred();
}

/* Lengthens the wheel's trace, which pictures for people show, or ends it. */
static bool skid(PyObject *car, PyObject *wheel, bool skids, bool grass)
{
    if (!skids)
        return PyObject_SetAttr(wheel, NAME(skid_start), Py_None) == 0 &&
               PyObject_SetAttr(wheel, NAME(skid_particle), Py_None) == 0;
    PyObject *result = PyObject_CallMethodObjArgs(car, NAME(skid), wheel, grass ? Py_True : Py_False, NULL);
    Py_XDECREF(result);
    return result;
}

static bool push(PyObject *wheel, double x, double y)
{
    PyObject *force = Py_BuildValue("dd", x, y);
    PyObject *result = force ? PyObject_CallMethodObjArgs(wheel, NAME(ApplyForceToCenter), force, Py_True, NULL) : NULL;
    Py_XDECREF(force);
    Py_XDECREF(result);
    return result;
}

/* The wheel's angular velocity after gas and brake. */
static double spin(double omega, double power, double brake, double inertia)
{
    omega += power / inertia / (fabs(omega) + 5.0);
    if (brake >= 0.9)
        return 0.0;
    return brake > 0 ? omega - sign(omega) * fmin(15.0 * brake, fabs(omega)) : omega;
}

static bool roll_wheel(PyObject *car, PyObject *wheel, const Constants *constants, double *fuel)
{
    double limit, omega, gas, brake, phase, radius, dt = constants->dt;
    bool grass;
    const Body *body = body_of(wheel);
    if (!(body && steer(wheel) && grip(wheel, constants->road, &limit, &grass) && get(wheel, NAME(omega), &omega) &&
          get(wheel, NAME(gas), &gas) && get(wheel, NAME(brake), &brake) && get(wheel, NAME(phase), &phase) &&
          get(wheel, NAME(wheel_rad), &radius)))
        return false;
    /* Box2D's GetWorldVector((1, 0)), in its single precision; forwards is (-sine, cosine) */
    float sine_once = sinf(body->angle), cosine_once = cosf(body->angle);
    double cosine = cosine_once * 1.0f - sine_once * 0.0f, sine = sine_once * 1.0f + cosine_once * 0.0f;
    double vx = body->vx, vy = body->vy, ahead = -sine * vx + cosine * vy, power = dt * constants->engine * gas;
    omega = spin(omega, power, brake, constants->inertia);
    *fuel += power;
    double forwards = (-ahead + omega * radius) * constants->stiffness;
    double sideways = -(cosine * vx + sine * vy) * constants->stiffness;
    double force = sqrt(forwards * forwards + sideways * sideways);
    if (!(set(wheel, NAME(phase), phase + omega * dt) && skid(car, wheel, force > 2.0 * limit, grass)))
        return false;
    if (force > limit) {
        forwards = forwards / force * limit;
        sideways = sideways / force * limit;
    }
    return set(wheel, NAME(omega), omega - dt * forwards * radius / constants->inertia) &&
           push(wheel, sideways * cosine + forwards * -sine, sideways * sine + forwards * cosine);
}

PyObject *roll(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *car, *wheel;
    Constants given;
    if (!PyArg_ParseTuple(args, "Oddddd", &car, &given.dt, &given.stiffness, &given.engine, &given.inertia, &given.road))
        return NULL;
    double fuel;
    PyObject *wheels = PyObject_GetAttr(car, NAME(wheels)), *all = wheels ? PyObject_GetIter(wheels) : NULL;
    Py_XDECREF(wheels);
    bool done = all && get(car, NAME(fuel_spent), &fuel);
    while (done && (wheel = PyIter_Next(all))) {
        done = roll_wheel(car, wheel, &given, &fuel);
        Py_DECREF(wheel);
    }
    Py_XDECREF(all);
    done = done && !PyErr_Occurred() && set(car, NAME(fuel_spent), fuel);
    return done ? Py_NewRef(Py_None) : NULL;
}
