/* Box2D's bodies, as they lie in memory. */
#ifndef DREAMFLEET_BODY_H
#define DREAMFLEET_BODY_H

#define Py_LIMITED_API 0x030b0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <stdbool.h>
#include <stdint.h>

/* b2Body of Box2D 2.3, up to the last field that is read. */
typedef struct {
    int32_t type;
    uint16_t flags;
    int32_t island;
    float x, y, sine, cosine;
    float local_centre[2], centre_before[2], centre[2], angle_before, angle, fraction;
    float vx, vy, spin;
    float force[2], torque;
    void *world, *before, *after, *fixtures;
    int32_t fixture_count;
    void *joints, *contacts;
    float mass[4], damping[2], gravity, sleep;
    PyObject *user;
} Body;

bool body_init(void);

/* The body of a Python object of Box2D; NULL with an error set if it is none. */
const Body *body_of(PyObject *object);

/* A number among the attributes of an object, read and set; false with an error set if it is none. */
bool get(PyObject *object, PyObject *name, double *value);
bool set(PyObject *object, PyObject *name, double value);

/* knows(contact): whether its fixtures and their bodies lie in memory as is assumed here. */
PyObject *knows(PyObject *self, PyObject *contact);

/* look(out, car): x, y, angle and phase of each wheel and of the hull, into 20 doubles. */
PyObject *look(PyObject *self, PyObject *args);

/* touch(listener, contact, begin): gymnasium's FrictionDetector._contact. */
PyObject *touch(PyObject *self, PyObject *args);

#endif
