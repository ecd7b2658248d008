"""Observations and actions of any space as flat vectors, as `gymnasium.spaces.flatten` writes them.

A number of a `Discrete` or `MultiDiscrete` space is one-hot there; entries of a `Dict` stand in the order of its keys.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from math import prod
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation, TransformAction
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Actions, Continuous, Discrete
from dreamfleet.common.errors import UsageError

Floats = NDArray[np.float32]
MAX_CHOICES = 64  # a controller has an output for each
LARGEST_WHOLE = 2**53  # of a whole number as an action; beyond it, double precision skips some
ENDS = ("low", "high")
NUMBERED = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)


def vector_actions(space: Any, name: str) -> Continuous:
    """The actions of a space as vectors `(A,)`: of float Boxes between their bounds, of numbered spaces as choices.

    `UsageError` with the environment's `name` for a space of both kinds or neither, or with too many choices.

    >>> vector_actions(spaces.MultiDiscrete([2, 3]), "it").choices[1]
    (1.0, 0.0, 0.0, 1.0, 0.0)
    """
    leaves = list(_leaves(space))
    if leaves and all(isinstance(each, spaces.Box) for each in leaves):
        for each in leaves:
            _check_box(each, name)
        low, high = ([getattr(each, end).ravel() for each in leaves] for end in ENDS)
        return Continuous.between(np.concatenate(low), np.concatenate(high))
    if not leaves or not all(isinstance(each, NUMBERED) for each in leaves):
        raise UsageError(f"{name} takes actions {space}: wrap it so that they are a flat Box of floats, or Discrete")
    if (count := prod(prod(_sizes(each)) for each in leaves)) > MAX_CHOICES:
        raise UsageError(f"{name} takes {count} different actions: wrap it so that they are {MAX_CHOICES} at most")
    rows = tuple(tuple(map(float, sum(parts, ()))) for parts in product(*map(_rows, leaves)))
    width = len(rows[0])
    return replace(Continuous.between([0.0] * width, [1.0] * width), choices=rows)


def make_converter(space: Any, actions: Continuous) -> Callable[[Floats], Any]:
    """What turns a vector of `vector_actions` into an action of the space: the nearest choice, if there are choices.

    Numbers get the type of their Box. They are rounded if that is whole, and clipped to the Box' own bounds: the single
    precision of a vector may lie beyond these, as float32(0.1) > 0.1 does.
    """
    table = np.array(actions.choices, dtype=np.float32)
    if len(table):
        return lambda action: spaces.unflatten(space, table[np.argmin(((table - action) ** 2).sum(axis=1))])
    leaves = list(_leaves(space))
    low, high = (np.concatenate([getattr(each, end).ravel() for each in leaves], dtype=np.float64) for end in ENDS)
    whole = np.concatenate([np.full(each.low.size, _is_whole(each)) for each in leaves])

    def convert(action: Floats) -> Any:
        exact = np.where(whole, np.rint(action), action).astype(np.float64)
        return spaces.unflatten(space, np.clip(exact, low, high))

    return convert


def flatten_environment(
    environment: gymnasium.Env[Any, Any], name: str, keys: Sequence[str] = ()
) -> tuple[gymnasium.Env[Any, Any], Actions]:
    """The environment for a controller without a world model, and the actions that it then takes.

    Box observations, Discrete actions and flat Boxes of float32 stay as they are. Other observations and actions become
    vectors, and other numbered actions one number. Of a Dict, `keys` are seen; without any, all that are numbers.
    `UsageError` where that is impossible.
    """
    observed, space = environment.observation_space, environment.action_space
    if keys or not isinstance(observed, spaces.Box):
        environment = FlattenObservation(_choose_numbers(environment, name, keys))
    if 0 in (environment.observation_space.shape or ()):
        raise UsageError(
            f"{name} observes no number ({observed}), and a controller acts on what it sees: let it observe one, such "
            "as a constant 1, or search its actions as a function (function:MODULE:NAME)"
        )
    if isinstance(space, spaces.Discrete):
        return environment, Discrete(int(space.n), int(space.start))
    actions = vector_actions(space, name)
    if isinstance(space, spaces.Box) and len(space.shape) == 1 and space.dtype == np.float32:
        return environment, actions
    convert = make_converter(space, actions)
    if not actions.choices:
        return TransformAction(environment, convert, spaces.flatten_space(space)), actions
    table = np.array(actions.choices, dtype=np.float32)
    numbers = spaces.Discrete(len(table))
    return TransformAction(environment, lambda number: convert(table[number]), numbers), Discrete(len(table))


class NumbersAlone(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Observes the numbers of a Dict or Tuple as a Dict, without text, graphs and sequences."""

    def __init__(self, environment: gymnasium.Env[Any, Any], numbers: spaces.Dict, left_out: Sequence[str]) -> None:
        """`left_out` names what is no number."""
        super().__init__(environment)
        self.observation_space = numbers
        self.left_out = tuple(left_out)

    def observation(self, observation: Any) -> Any:
        """The numbers."""
        return _pick(self.observation_space, observation)


def _choose_numbers(environment: gymnasium.Env[Any, Any], name: str, keys: Sequence[str]) -> gymnasium.Env[Any, Any]:
    """The environment with what a controller sees of it, all if all are numbers; `UsageError` if nothing is left."""
    observed = environment.observation_space
    entries = observed.spaces if isinstance(observed, spaces.Dict) else {}
    if unknown := [key for key in keys if key not in entries]:
        known = f"it observes {', '.join(map(str, entries))}" if entries else "it does not observe a Dict: omit it"
        raise UsageError(f"{name} has no {', '.join(unknown)} for --observation: {known}")
    chosen = spaces.Dict({key: entries[key] for key in keys}) if keys else observed
    paths = [path for path, each in _paths(chosen) if not is_of_numbers(each)]
    numbers = _numbers(chosen)
    if numbers is None or any(_numbers(entries[key]) is None for key in keys):
        raise UsageError(
            f"{name} observes {chosen}: wrap it so that it observes numbers (Box, Discrete, MultiDiscrete, "
            "MultiBinary, or a Dict or Tuple of these)"
        )
    return NumbersAlone(environment, numbers, paths) if keys or paths else environment


def is_of_numbers(space: Any) -> bool:
    """Whether all of a space, however deep, are numbers that a controller can see."""
    return all(isinstance(each, (spaces.Box, *NUMBERED)) for each in _leaves(space))


def _numbers(space: Any) -> Any:
    """The space without what is no number, and Tuples as Dicts; `None` if nothing is left."""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        kept = {key: found for key, each in _entries(space) if (found := _numbers(each)) is not None}
        return spaces.Dict(kept) if kept else None
    return space if is_of_numbers(space) else None


def _pick(numbers: Any, observation: Any) -> Any:
    """What a space of `_numbers` holds of an observation."""
    if isinstance(numbers, spaces.Dict):
        return {key: _pick(each, observation[key]) for key, each in numbers.spaces.items()}
    return observation


def _paths(space: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """The spaces in a Dict or Tuple, however deep, each with its keys from the outermost on."""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        for key, each in _entries(space):
            yield from _paths(each, f"{path}.{key}" if path else str(key))
    else:
        yield path, space


def _entries(space: Any) -> list[tuple[Any, Any]]:
    return list(space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces))


def _leaves(space: Any) -> Iterator[Any]:
    """The spaces in a Dict or Tuple, however deep, in the order in which they are flattened."""
    return (each for _, each in _paths(space))


def _check_box(space: spaces.Box, name: str) -> None:
    if 0 in space.shape:
        raise UsageError(f"{name} takes actions {space}: a controller gives at least one number")
    low, high = (np.asarray(each, np.float64) for each in (space.low, space.high))
    is_endless = _is_whole(space) and bool((np.abs([low, high]) > LARGEST_WHOLE).any())
    with np.errstate(over="ignore"):  # actions are float32, and so are drawn ones of their whole range
        reach = np.stack([low, high, high - low]).astype(np.float32)
    if is_endless or not np.isfinite(reach).all():
        raise UsageError(f"{name} takes actions without bounds: wrap it so that its actions have a range")


def _is_whole(space: spaces.Box) -> bool:
    return not np.issubdtype(space.dtype, np.floating)


def _sizes(space: Any) -> list[int]:
    """How many values each number of a numbered space has."""
    if isinstance(space, spaces.MultiBinary):
        return [2] * int(np.prod(space.shape))
    return [int(space.n)] if isinstance(space, spaces.Discrete) else space.nvec.ravel().tolist()


def _rows(space: Any) -> Iterator[tuple[int, ...]]:
    """Every element of a numbered space, flattened; the last number varies fastest."""
    sizes = _sizes(space)
    for numbers in product(*map(range, sizes)):
        if isinstance(space, spaces.MultiBinary):
            yield numbers
        else:
            yield tuple(int(k == number) for number, size in zip(numbers, sizes, strict=True) for k in range(size))
