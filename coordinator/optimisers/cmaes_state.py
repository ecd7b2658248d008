"""The exact state of a strategy of the library `cmaes` as named arrays: the attributes that an update reads.

The library offers pickle, and drops the random generator from it. It keeps its state in attributes of its own, which we
name one by one; what its constructor derives from its arguments stays as constructed. Its history of fitness is left
out: only its termination criteria look at it, which nobody asks, and its first values are whatever lay in memory.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.coordinator.optimisers.api import State
from dreamfleet.coordinator.optimisers.scalars import tag, untag


def dump(strategy: Any, names: Sequence[str]) -> State:
    """The named attributes (without their underscore), and the generator's state."""
    arrays: State = {}
    scalars: dict[str, list[Any]] = {}
    for name in names:
        value = getattr(strategy, f"_{name}")
        if isinstance(value, np.ndarray):
            arrays[name] = value.copy()
        else:
            scalars[name] = tag(value)
    random = strategy._rng.get_state(legacy=False)
    arrays["random.key"] = random["state"].pop("key").copy()
    random["gauss"] = tag(random["gauss"])
    arrays["scalars"] = np.array(json.dumps(scalars, sort_keys=True))
    arrays["random"] = np.array(json.dumps(random, sort_keys=True))
    return arrays


def restore(strategy: Any, names: Sequence[str], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Put the named attributes back; `KeyError` if one is not there."""
    scalars = json.loads(str(arrays["scalars"]))
    for name in names:
        setattr(strategy, f"_{name}", untag(scalars[name]) if name in scalars else arrays[name].copy())
    random = json.loads(str(arrays["random"]))
    random["state"]["key"] = arrays["random.key"]
    random["gauss"] = untag(random["gauss"])
    strategy._rng.set_state(random)
