/* The car's wheels for Python. */
#ifndef DREAMFLEET_ROLL_H
#define DREAMFLEET_ROLL_H

#define Py_LIMITED_API 0x030b0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <stdbool.h>

bool roll_init(void);

/* roll(car, dt, stiffness, engine, inertia, road): move the wheels and apply their forces for `dt` seconds. */
PyObject *roll(PyObject *self, PyObject *args);

#endif
