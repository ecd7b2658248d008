"""Tests of dreamfleet. NumPy and torch use one thread in them, as in the product's slots: two wait for each other."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read as the libraries are loaded; processes that tests start inherit it
