"""What a function of a vector is searched by: how search coordinates become its arguments, and fitness its value.

Coordinates count from `x0`, in steps of `scale`. They travel in single precision, so that they hold about seven digits
of the way from `x0`. A coordinate beyond a bound is reflected there (mirroring; Wessing 2013, "Repair methods for box
constraints revisited"), as pycma's bound transform does, so that every coordinate has an argument within the bounds.
"""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural

Floats = NDArray[np.float64]
LARGEST_EXPONENT = 700.0  # of e: above it no double is finite
KEY = "environment"  # of a task's options, as `--environment` gives them: docs/reference/tasks.md
EXAMPLE = "x0=[0,0,0]"  # docs/reference/python.md has the same as arguments
_DEFAULTS: dict[str, Any] = {
    "scale": 1.0, "lower": None, "upper": None, "integer": [], "log": [], "minimise": False, "penalty": None,
}  # fmt: skip


@dataclass(frozen=True)
class Objective:
    """A function's arguments and the sign of its value; vectors have a number for each parameter.

    A parameter in `log` is searched by its natural logarithm, one in `integer` is rounded. An unbounded side is
    infinite, and equal bounds fix a parameter. `penalty` replaces a value that is NaN or infinite; without one, such a
    candidate counts as failed.

    >>> box = Objective.of({"x0": [0.5, 10], "lower": [0, 1], "upper": [1, 1000], "log": [1], "minimise": True})
    >>> box.decode(np.array([0.0, 0.0])).round(9).tolist(), box.decode(np.array([0.75, 1.0])).round(2).tolist()
    ([0.5, 10.0], [0.75, 27.18])
    >>> box.value(-3.0)
    3.0
    """

    x0: tuple[float, ...]
    scale: tuple[float, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    integer: tuple[int, ...] = ()
    log: tuple[int, ...] = ()
    minimise: bool = False
    penalty: float | None = None

    @property
    def dimension(self) -> int:
        """Number of parameters."""
        return len(self.x0)

    @classmethod
    def of(cls, arguments: Mapping[str, Any]) -> Objective:
        """An objective from KEY=VALUE arguments; `UsageError` names the one that is wrong.

        `dimension` and numbers in place of lists count for all parameters; null is no bound; `log` and `integer` list
        parameters from 0 on, or are true for all.
        """
        if not isinstance(arguments, Mapping):
            raise UsageError(f"a function's options are names with values, not {arguments!r:.100}")
        known = (*(each.name for each in fields(cls)), "dimension")
        if unknown := sorted(set(arguments) - set(known)):
            raise UsageError(f"a function has no option {', '.join(unknown)}: it has {', '.join(known)}")
        x0 = _numbers("x0", arguments.get("x0"), _whole("dimension", arguments.get("dimension")))
        size = len(x0)
        scale = _numbers("scale", arguments.get("scale", 1.0), size)
        lower = _numbers("lower", arguments.get("lower"), size, -math.inf)
        upper = _numbers("upper", arguments.get("upper"), size, math.inf)
        integer, log = (_indices(name, arguments.get(name, ()), size) for name in ("integer", "log"))
        penalty = arguments.get("penalty")
        if penalty is not None:
            (penalty,) = _numbers("penalty", penalty, 1)
        if not isinstance(minimise := arguments.get("minimise", False), bool):
            raise UsageError(f"minimise must be true or false, not {minimise!r}")
        found = cls(x0, scale, lower, upper, integer, log, minimise, penalty)
        found._check()
        return found

    @classmethod
    def parse(cls, options: str) -> Objective:
        """The objective in a task's frozen options; `UsageError` if they hold none."""
        try:
            return cls.of(json.loads(options)[KEY])
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise UsageError(f"these options describe no function: {options:.200}") from error

    def _check(self) -> None:
        for index, (x0, scale, lower, upper) in enumerate(
            zip(self.x0, self.scale, self.lower, self.upper, strict=True)
        ):
            if not scale > 0:
                raise UsageError(f"scale of parameter {index} must be above 0, not {scale:g}")
            if not lower <= upper:
                raise UsageError(f"the bounds of parameter {index} are {lower:g} and {upper:g}: the lower one is above")
            if not lower <= x0 <= upper:
                raise UsageError(f"x0 of parameter {index} is {x0:g}, outside of its bounds {lower:g} and {upper:g}")
            if index in self.integer and not any(map(math.isinf, (lower, upper))) and math.ceil(lower) > upper:
                raise UsageError(f"no whole number is within the bounds {lower:g} and {upper:g} of parameter {index}")
            if index in self.log and not (x0 > 0 and (lower == -math.inf or lower > 0)):
                raise UsageError(f"parameter {index} is logarithmic: its x0 and lower bound must be above 0")
        if self.lower == self.upper:
            raise UsageError("the bounds fix every parameter: leave one of them a range to search")

    @property
    def arguments(self) -> dict[str, Any]:
        """What `of` reads: what differs from the defaults, equal numbers as one."""
        vectors = {name: _shorten(getattr(self, name)) for name in ("scale", "lower", "upper")}
        found = {**vectors, "integer": list(self.integer), "log": list(self.log), "minimise": self.minimise,
                 "penalty": self.penalty}  # fmt: skip
        own = {name: value for name, value in found.items() if value != _DEFAULTS[name]}
        return {"dimension": self.dimension, "x0": _shorten(self.x0), **own}

    @property
    def options(self) -> str:
        """Canonical JSON that a run freezes."""
        return json.dumps({KEY: self.arguments}, sort_keys=True)

    def decode(self, coordinates: Any) -> Floats:
        """The arguments `(dimension,)` of search coordinates `(dimension,)`."""
        given = np.asarray(coordinates, dtype=np.float64)
        if given.shape != (self.dimension,):
            raise UsageError(
                f"a function of {plural(self.dimension, 'parameter')} takes no coordinates of shape {given.shape}"
            )
        inner, low, high = (np.array(each) for each in zip(*map(self._inner, range(self.dimension)), strict=True))
        found = _reflect(inner + np.array(self.scale) * given, low, high)
        for index in self.log:  # one by one: NumPy's vectors of exponentials have other bits on other processors
            found[index] = math.exp(min(found[index], LARGEST_EXPONENT))
        for index in self.integer:
            found[index] = np.rint(found[index])
        return np.clip(found, self.lower, self.upper)

    def _inner(self, index: int) -> tuple[float, float, float]:
        """A parameter's x0 and bounds as they are searched: rounded at their ends, or as logarithms."""
        found = [self.x0[index], self.lower[index], self.upper[index]]
        if index in self.integer:  # so that the outermost numbers are as probable as others
            half = 0.499
            found[1:] = (
                math.ceil(found[1]) - half if math.isfinite(found[1]) else found[1],
                (math.floor(found[2]) + half if math.isfinite(found[2]) else found[2]),
            )
        if index in self.log:
            found = [math.log(each) if 0 < each < math.inf else math.copysign(math.inf, each) for each in found]
        return found[0], found[1], found[2]

    def value(self, fitness: float) -> float:
        """The function's value of a fitness, and the fitness of a value."""
        return 0.0 - fitness if self.minimise else fitness  # no -0.0


def describe_sign(options: str) -> str:
    """What a reader of values must know of a function's task with these options; empty: nothing.

    >>> describe_sign(Objective.of({"x0": [0, 0], "minimise": True}).options)
    'minimised: smaller values are better'
    """
    try:
        minimised = Objective.parse(options).minimise
    except UsageError:
        return ""
    return "minimised: smaller values are better" if minimised else ""


def takes_seed(function: Callable[..., Any]) -> bool:
    """Whether a function of a vector is noisy: a parameter behind its first one is named `seed`, and has no value yet.

    >>> takes_seed(lambda x, seed: 0.0), takes_seed(lambda x: 0.0)
    (True, False)
    """
    if isinstance(function, partial) and "seed" in function.keywords:
        return False
    try:
        names = list(inspect.signature(function).parameters)
    except (ValueError, TypeError):  # some builtin functions have no signature
        return False
    return "seed" in names[1:]


def _reflect(values: Floats, low: Floats, high: Floats) -> Floats:
    """Mirror values at bounds, which may be infinite, as often as it takes; those within stay as they are."""
    found = values.copy()
    for index, (value, lower, upper) in enumerate(zip(values.tolist(), low.tolist(), high.tolist(), strict=True)):
        if lower <= value <= upper:
            continue
        if lower == upper:
            found[index] = lower
            continue
        if math.isfinite(lower) and math.isfinite(upper):
            way = (value - lower) % (2 * (upper - lower))
            found[index] = lower + min(way, 2 * (upper - lower) - way)
        else:
            found[index] = 2 * lower - value if value < lower else 2 * upper - value
    return found


def _numbers(name: str, given: Any, size: int | None, missing: float | None = None) -> tuple[float, ...]:
    """A number for each parameter; null is `missing`, if there is such a value."""
    if isinstance(given, str):
        given = [each.strip() for each in given.split(",")]
        given = given[0] if len(given) == 1 else given
    if not isinstance(given, Sequence) or isinstance(given, str):
        if given is None and missing is None:
            raise UsageError(f"{name} is missing: give a number for each parameter, such as {EXAMPLE}")
        given = [given] * (1 if size is None else size)
    values = tuple(missing if each is None and missing is not None else _number(name, each) for each in given)
    if not values or (size is not None and len(values) != size):
        raise UsageError(
            f"{name} has {plural(len(values), 'number')}, and the function {size or 'at least 1'} parameters"
        )
    return values


def _number(name: str, given: Any) -> float:
    try:
        value = math.nan if isinstance(given, bool) else float(given)
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise UsageError(f"{name} must hold finite numbers, such as {EXAMPLE}, not {given!r}")
    return value


def _whole(name: str, given: Any) -> int | None:
    if given is None:
        return None
    if not isinstance(given, int) or isinstance(given, bool) or not 0 < given < 10**6:
        raise UsageError(f"{name} must be a whole number above 0, not {given!r}")
    return given


def _indices(name: str, given: Any, size: int) -> tuple[int, ...]:
    if isinstance(given, bool):
        return tuple(range(size)) if given else ()
    listed = [given] if isinstance(given, int) else given
    whole = isinstance(listed, Sequence) and all(isinstance(each, int) and 0 <= each < size for each in listed)
    if not whole:
        raise UsageError(f"{name} lists parameters by their numbers from 0 to {size - 1}, or is true, not {given!r}")
    return tuple(sorted(set(listed)))


def _shorten(values: Sequence[float]) -> Any:
    """One number for all if they are equal, infinite ones as null."""
    plain = [each if math.isfinite(each) else None for each in values]
    return plain[0] if len(set(plain)) == 1 else plain
