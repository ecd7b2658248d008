"""Functions of a vector that tests search."""

import functools
import os
import sys
from pathlib import Path

import numpy as np


def sphere(x):
    return float(np.square(x - 1).sum())


def flat(_x):
    return 2.5


def noisy(x, seed):
    return float(np.square(x).sum() + 0.1 * np.random.default_rng(seed).normal())


def holed(x):
    """Not a number on a side of its optimum."""
    return sphere(x) if x[0] < 1.2 else float("nan")


def raising(_x):
    return 1 // 0


def brittle(x, seed):
    return sphere(x) if seed % 4 else 1 // 0


def exiting(_x):
    sys.exit(3)


def nothing(_x):
    return None


def vector(x):
    return x


def text(_x):
    return "12"


def narrow(x):
    """Has a value only near zero, where it is tried before a run begins."""
    return 1 / 0 if abs(x).max() > 8 else 0.0


def losing(x):
    """Has no value any more once a file exists."""
    return float("nan") if Path(os.environ.get("LOST", "nowhere")).exists() else sphere(x)


def infinite(_x):
    return float("inf")


def changing(x):
    """Writes into its argument."""
    x += 1
    return float(x.sum())


def varying(_x):
    return float(np.random.default_rng().normal())


class Shifted:
    """A function in a class."""

    @staticmethod
    def value(x):
        return sphere(x)

    @classmethod
    def of_class(cls, x):
        return cls.value(x)

    def method(self, x):
        return self.value(x)


class Weighted:
    """A function as an object, and with another name as a method of one."""

    def __init__(self, weight):
        self.weight = weight

    def __call__(self, x):
        assert self.weight > 0
        return self.weight * sphere(x)

    def noisy(self, x, seed):
        return self(x) + 0.1 * np.random.default_rng(seed).normal()


weighted, wrong = Weighted(3), Weighted(-1)
steady = functools.partial(noisy, seed=1)


def outer():
    def inner(x):
        return sphere(x)

    return inner


NUMBER = 3
