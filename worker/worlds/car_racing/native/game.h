/* CarRacing without its picture, for Python. */
#ifndef DREAMFLEET_GAME_H
#define DREAMFLEET_GAME_H

#define Py_LIMITED_API 0x030b0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

/* The type `Race`. */
PyObject *game_type(void);

#endif
