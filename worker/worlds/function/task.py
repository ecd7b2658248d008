"""A Python function of a vector as a task: an environment of one step, whose reward is the function's value.

The task's name is `function:MODULE:NAME`. There is no controller: a candidate's numbers are the coordinates of the
function's arguments. What the coordinates mean stands in the task's options (`common/artifacts/objective.py`).
Pages: python.md.
"""

from __future__ import annotations

import inspect
import math
import traceback
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.objective import KEY, Objective, takes_seed
from dreamfleet.common.artifacts.task_options import check_options
from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.host.packages import find_distributions
from dreamfleet.common.host.trusted_modules import find_attribute, import_trusted
from dreamfleet.common.host.user_code import describe_error
from dreamfleet.common.printable import one_line
from dreamfleet.common.protocol.tasks import FUNCTION
from dreamfleet.common.runs.seeds import fold_seed
from dreamfleet.worker.tasks.api import Assignment, Continuous, Description, Policy, Task, World

Floats = NDArray[np.float64]


class ObjectiveError(DreamfleetError):
    """A function raised, or returned what is not one finite number; the text says which."""


class FunctionTask(Task):
    """The task `function:MODULE:NAME`: a function of a vector, and of a seed if a parameter of it has that name.

    >>> from dreamfleet.common.host.trusted_modules import trust
    >>> trust(["math"])  # as `--task function:math:fsum` does
    >>> FunctionTask("math:fsum").describe({"environment": {"x0": [1, 2]}}).outputs
    2
    """

    probe_steps: ClassVar[int] = 1

    def __init__(self, place: str = "") -> None:
        self.name = f"{FUNCTION}:{place}"
        self.function = _find_function(place)
        self._takes_seed = takes_seed(self.function)
        module = self.function.__module__ if inspect.isroutine(self.function) else place.partition(":")[0]
        self._packages = tuple(dict.fromkeys(("numpy", *find_distributions(module)[:1])))

    def world_of(self, assignment: Assignment) -> World:
        """A world of one step."""
        size = assignment.controller.size
        return World(Continuous.between([-1.0] * size, [1.0] * size), self._packages, horizon=1)

    def make_environment(self, assignment: Assignment) -> gymnasium.Env[Any, Any]:
        """The environment whose step calls the function."""
        objective = Objective.parse(assignment.spec.options)
        return FunctionEnvironment(self.name.rpartition(":")[2], self.function, objective, takes_seed=self._takes_seed)

    def make_policy(self, assignment: Assignment) -> Policy:
        """What turns a candidate's coordinates into the function's arguments."""
        return CoordinatePolicy(Objective.parse(assignment.spec.options))

    def describe(self, options: Mapping[str, Any]) -> Description:
        """As many outputs as parameters, without observations; `UsageError` for a wrong option."""
        check_options(f"task {self.name}", options, (KEY,))
        objective = Objective.of(options.get(KEY) or {})
        return Description(0, objective.dimension, self._packages, options=objective.options)


class CoordinatePolicy:
    """Its action is the vector of the function's arguments, whatever it observes."""

    def __init__(self, objective: Objective) -> None:
        self._objective = objective

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Start an episode with a candidate's coordinates `(size,)`."""
        self._arguments = self._objective.decode(parameters)

    def act(self, _observation: Any) -> Floats:
        """The arguments `(dimension,)`, a new array each time: a function may change it."""
        return self._arguments.copy()


class FunctionEnvironment(gymnasium.Env[Any, Any]):
    """One step: the action is the function's vector, the reward its value or the negative of it."""

    def __init__(self, name: str, function: Callable[..., Any], objective: Objective, *, takes_seed: bool) -> None:
        self._name, self._function, self._objective, self._takes_seed = name, function, objective, takes_seed
        self._seed = 0
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (0,), np.float32)
        self.action_space = gymnasium.spaces.Box(-np.inf, np.inf, (objective.dimension,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Keep the seed for the next step, folded to 31 bits; nothing is observed."""
        super().reset(seed=seed, options=options)
        self._seed = fold_seed(seed or 0)
        return np.zeros(0, np.float32), {}

    def step(self, action: Floats) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Call the function; `ObjectiveError` if it raises or returns no finite number."""
        value = self._call(action)
        if not math.isfinite(value):
            if self._objective.penalty is None:
                raise ObjectiveError(
                    f"{self._name} returned {value}: it needs a finite value, or a penalty in its place"
                )
            value = self._objective.penalty
        return np.zeros(0, np.float32), self._objective.value(value), True, False, {}

    def _call(self, action: Floats) -> float:
        try:
            returned = self._function(action, seed=self._seed) if self._takes_seed else self._function(action)
        except (Exception, SystemExit) as error:
            raise ObjectiveError(_describe_raised(self._name, self._function, error)) from error
        return _to_number(self._name, returned)


def _describe_raised(name: str, function: Callable[..., Any], error: BaseException) -> str:
    what = one_line(str(error))
    if not what:
        return f"{name} raised {describe_error(error)}"
    return f"{name} raised {type(error).__name__}: {what}{_find_line(function, error)}"


def _find_line(function: Callable[..., Any], error: BaseException) -> str:
    """The last line of the function's own file that led to the error, as " (FILE:LINE)"; empty if there is none."""
    while isinstance(function, partial):
        function = function.func
    code = getattr(inspect.unwrap(function), "__code__", None) or getattr(type(function).__call__, "__code__", None)
    if code is None:
        return ""
    frames = ((frame.f_code.co_filename, line) for frame, line in traceback.walk_tb(error.__traceback__))
    lines = [line for file, line in frames if file == code.co_filename]
    return f" ({Path(code.co_filename).name}:{lines[-1]})" if lines else ""


def _to_number(name: str, returned: Any) -> float:
    """What a function returned as a float; `ObjectiveError` if it is not one number."""
    if isinstance(returned, (str, bytes)) or returned is None or np.size(returned) != 1:
        shape = getattr(returned, "shape", ())
        what = f"an array of shape {shape}" if shape else f"{type(returned).__name__} {one_line(repr(returned))[:60]}"
        raise ObjectiveError(f"{name} returned {what}: it must return one number")
    try:
        return float(np.asarray(returned).reshape(()))
    except (TypeError, ValueError) as error:
        raise ObjectiveError(f"{name} returned {type(returned).__name__}: it must return one number") from error


def _find_function(place: str) -> Callable[..., Any]:
    """The function at `MODULE:NAME`; `UsageError` if there is none, errors of the import as they are."""
    module, colon, name = place.partition(":")
    if not (module and colon and name):
        raise UsageError(f"task {FUNCTION}:{place} names no function: write {FUNCTION}:MODULE:NAME")
    imported = import_trusted(module, f"task '{FUNCTION}:{place}'")
    try:
        found = find_attribute(imported, name)
    except AttributeError as error:
        raise UsageError(
            f"task {FUNCTION}:{place}: {module} has no function {name} once it is imported ({error}): what stands "
            'under `if __name__ == "__main__":` is not there'
        ) from error
    if not callable(found):
        raise UsageError(f"task {FUNCTION}:{place}: {name} of {module} is no function but {type(found).__name__}")
    function: Callable[..., Any] = found
    return function
