"""Observations and actions of any space as flat vectors, as `gymnasium.spaces.flatten` writes them.

A number of a `Discrete` or `MultiDiscrete` space is one-hot there; entries of a `Dict` stand in the order of its keys.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation, TransformAction
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import MAX_OUTPUTS, Actions, Continuous, Discrete, grouped, one_hot
from dreamfleet.common.errors import UsageError

Floats = NDArray[np.float32]
LARGEST_WHOLE = 2**53  # of a whole number as an action; beyond it, double precision skips some
ENDS = ("low", "high")
NUMBERED = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)


def vector_actions(space: Any, name: str) -> Continuous:
    """The actions of a space as vectors `(A,)`: of Boxes between their bounds, of numbered spaces by groups of outputs.

    `UsageError` with the environment's `name` for a space of both kinds or neither, or with too many outputs.

    >>> vector_actions(spaces.MultiDiscrete([11, 11, 11]), "it").outputs
    33
    """
    leaves = list(_leaves(space))
    if leaves and all(isinstance(each, spaces.Box) for each in leaves):
        for each in leaves:
            _check_box(each, name)
        low, high = ([getattr(each, end).ravel() for each in leaves] for end in ENDS)
        _check_outputs(sum(each.low.size for each in leaves), name)
        return Continuous.between(np.concatenate(low), np.concatenate(high))
    numbered = leaves if all(isinstance(each, NUMBERED) for each in leaves) else []
    sizes = [(size, isinstance(each, spaces.MultiBinary)) for each in numbered for size in _sizes(each)]
    if not sizes:
        raise UsageError(f"{name} takes actions {space}: wrap it so that they are a flat Box of floats, or Discrete")
    _check_outputs(sum(size for size, _ in sizes), name)
    if isinstance(space, spaces.Discrete):
        return one_hot(int(space.n))
    return grouped([size for size, _ in sizes], [index for index, (_, is_bit) in enumerate(sizes) if is_bit])


def make_converter(space: Any, actions: Continuous) -> Callable[[Floats], Any]:
    """What turns a vector of `vector_actions` into an action of the space: the nearest one, if it has numbered ones.

    Numbers get the type of their Box. They are rounded if that is whole, and clipped to the Box' own bounds: the single
    precision of a vector may lie beyond these, as float32(0.1) > 0.1 does.
    """
    if actions.sizes:
        return lambda action: _element(space, iter(actions.to_numbers(action)))
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
    vectors. Of a Dict, `keys` are seen; without any, all that are numbers.
    `UsageError` where that is impossible.
    """
    observed, space = environment.observation_space, environment.action_space
    if keys or not isinstance(observed, spaces.Box):
        environment = FlattenObservation(_choose_numbers(environment, name, keys))
    if 0 in (environment.observation_space.shape or ()):
        raise UsageError(
            f"{name} observes no number ({observed}), and a controller acts on what it sees: let it observe one, such "
            "as a constant 1, or search its actions as a function (`function:MODULE:NAME`)"
        )
    if isinstance(space, spaces.Discrete):
        _check_outputs(int(space.n), name)
        return environment, Discrete(int(space.n), int(space.start))
    actions = vector_actions(space, name)
    if isinstance(space, spaces.Box) and len(space.shape) == 1 and space.dtype == np.float32:
        return environment, actions
    # Drawn numbers from 0 to 1 choose evenly in each group.
    drawn = spaces.Box(0, 1, (actions.actions,), np.float32) if actions.sizes else spaces.flatten_space(space)
    return TransformAction(environment, make_converter(space, actions), drawn), actions


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


def _check_outputs(count: int, name: str) -> None:
    if count > MAX_OUTPUTS:
        raise UsageError(
            f"{name} takes actions by {count} outputs of a controller: wrap it so that they are {MAX_OUTPUTS} at most"
        )


def _element(space: Any, numbers: Iterator[Any]) -> Any:
    """The element of a numbered space whose leaves take the next of these numbers, each from 0."""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        parts = {key: _element(each, numbers) for key, each in _entries(space)}
        return parts if isinstance(space, spaces.Dict) else tuple(parts.values())
    if isinstance(space, spaces.Discrete):
        return space.start + np.int64(next(numbers))
    taken = np.array(list(islice(numbers, len(_sizes(space)))))
    if isinstance(space, spaces.MultiBinary):
        return taken.astype(space.dtype).reshape(space.shape)
    return (taken.reshape(space.shape) + space.start).astype(space.dtype)


def _sizes(space: Any) -> list[int]:
    """How many values each number of a numbered space has."""
    if isinstance(space, spaces.MultiBinary):
        return [2] * int(np.prod(space.shape))
    return [int(space.n)] if isinstance(space, spaces.Discrete) else space.nvec.ravel().tolist()
