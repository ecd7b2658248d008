"""The exact state of a pycma strategy as named arrays, so that a run continues to the bit without pickle.

pycma offers pickle alone. Its state lives in nested plain objects; we walk them and keep every leaf that is a number,
a text, an array, or a list of those. What the constructor derives from the options is overwritten with equal values,
which costs a few kilobytes and needs no list of names that the next version of pycma would outdate. A test compares
continued and uninterrupted runs for each covariance model.
"""

import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.coordinator.optimisers.checkpoint import SCALARS, tag, untag

# Not state: options and callbacks come from the constructor; the clock, the logger, archives and the last population
# with its fitness, which are large, change no sample.
_SKIPPED = frozenset({
    "opts", "inopts", "_es_opts", "logger", "timer", "timer2", "_tell2_args", "sent_solutions", "archive", "randn",
    "repaired_solutions", "_injected_solutions_archive", "_stopdict", "callbackstop", "boundary_handler", "gp",
    "_parameters", "params", "more_to_write", "best", "ary", "pop_sorted", "_is_independent_sample",
    "fit.fit", "fit.bndpen",
})  # fmt: skip
_MAX_DEPTH = 6
_MISSING = object()


def dump(strategy: Any) -> dict[str, NDArray[Any]]:
    """The strategy's leaves: arrays under their dotted path, and one text `about` for scalars and lists."""
    arrays: dict[str, NDArray[Any]] = {}
    about: dict[str, Any] = {}
    for path, value in _leaves(strategy):
        if isinstance(value, np.ndarray):
            arrays[path] = value.copy()
        elif isinstance(value, (list, range)):
            tags = [["array"] if isinstance(item, np.ndarray) else tag(item) for item in value]
            about[path] = ["list", len(value), tags]
            for index, item in enumerate(value):
                if isinstance(item, np.ndarray):
                    arrays[f"{path}.{index}"] = item.copy()
        else:
            about[path] = tag(value)
    arrays["about"] = np.array(json.dumps(about, sort_keys=True))
    return arrays


def restore(strategy: Any, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Put the leaves back into a strategy built with the same options; `KeyError` if it is of another shape."""
    about = json.loads(str(arrays["about"]))
    written: dict[int, bytes] = {}
    for path in [*(name for name in arrays if name != "about"), *about]:
        if path in about or path.rpartition(".")[0] not in about:
            *parents, name = path.split(".")
            owner = strategy
            for parent in parents:
                owner = vars(owner)[parent]
            _assign(owner, name, _value(path, about, arrays), written)


def is_before_first_update(arrays: Mapping[str, NDArray[Any]]) -> bool:
    """Whether the strategy was never updated: it lacks the parts that the first update makes."""
    return int(untag(json.loads(str(arrays["about"]))["countiter"])) == 0


def _leaves(value: Any, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """The dotted path and the value of every leaf below `value`."""
    for name, child in vars(value).items():
        path = f"{prefix}{name}"
        if name in _SKIPPED or path in _SKIPPED or callable(child):
            continue
        if _is_leaf(child):
            yield path, child
        elif hasattr(child, "__dict__") and depth < _MAX_DEPTH:
            yield from _leaves(child, f"{path}.", depth + 1)


def _is_leaf(value: Any) -> bool:
    if type(value) in (list, range):  # the indices of mirrored samples are a range
        return all(isinstance(item, (*SCALARS, np.ndarray)) for item in value)
    return isinstance(value, SCALARS) or type(value) is np.ndarray


def _value(path: str, about: dict[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Any:
    if path not in about:
        return arrays[path].copy()
    if about[path][0] != "list":
        return untag(about[path])
    tags = about[path][2]
    return [arrays[f"{path}.{i}"].copy() if tag == ["array"] else untag(tag) for i, tag in enumerate(tags)]


def _assign(owner: Any, name: str, value: Any, written: dict[int, bytes]) -> None:
    """Set a leaf; `written` holds what this restoring wrote into which array.

    pycma shares some arrays between its objects, such as `C` with `sm.C`, so a value goes into the array that is there.
    Other arrays are only the same for the moment: the object that watches for stagnation keeps the mean itself until it
    stands still. Two values for one array mean that it is no longer shared: the second owner gets its own.
    """
    old = vars(owner).get(name, _MISSING)
    if not (isinstance(old, np.ndarray) and isinstance(value, np.ndarray) and old.shape == value.shape):
        vars(owner)[name] = value
    elif not old.flags.writeable:
        return  # a view, such as dC of C, which follows what it looks at
    elif written.setdefault(id(old), value.tobytes()) == value.tobytes():
        old[...] = value
    else:
        vars(owner)[name] = value
