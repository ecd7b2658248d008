"""An optimiser's state as a run's journal keeps it: its arrays under a head that says whose they are."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import JournalError
from dreamfleet.common.files.archives import ArchiveLimits, read_arrays
from dreamfleet.common.printable import one_line
from dreamfleet.coordinator.optimisers.api import State
from dreamfleet.coordinator.optimisers.scalars import untag

PREFIX = "optimiser."
_LIMITS = ArchiveLimits(1 << 30, members=4096)  # bytes: more than SQLite keeps in one place


@dataclass(frozen=True)
class Head:
    """Which optimiser wrote a state with what installed, its mean `(dimension,)` and its step size.

    A search in a subspace has an origin `(dimension,)` too, from which its coordinates count.
    """

    name: str
    requirement: str
    mean: NDArray[np.float64]
    sigma: float
    origin: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Checkpoint:
    """A state between tell and ask; to pack it takes a while, which can be left for later."""

    head: Head
    state: State

    def packed(self) -> bytes:
        """As one `.npz`."""
        head = {PREFIX + name: np.array(value) for name, value in vars(self.head).items() if value is not None}
        buffer = io.BytesIO()
        np.savez(buffer, **self.state, **head)  # type: ignore[arg-type]
        return buffer.getvalue()

    @classmethod
    def unpack(cls, data: bytes) -> Checkpoint:
        """Read what `packed` wrote, also of version 0.1; never pickle."""
        try:
            return cls._of(read_arrays(data, _LIMITS))
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            why = one_line(str(error))
            raise JournalError(f"the journal's last state is damaged ({why}): restore it from a copy") from error

    @classmethod
    def _of(cls, arrays: State) -> Checkpoint:
        head = {name: arrays.pop(name) for name in [*arrays] if name.startswith(PREFIX)}
        if not head:
            return cls(_version_01_head(arrays), arrays)
        name, requirement, mean, sigma = (head[PREFIX + each] for each in ("name", "requirement", "mean", "sigma"))
        return cls(Head(str(name), str(requirement), mean, float(sigma), head.get(PREFIX + "origin")), arrays)


def _version_01_head(arrays: State) -> Head:
    """The head of a state of version 0.1, which had pycma alone; takes its own words out of the arrays."""
    if "cma" not in arrays:
        raise JournalError("the journal's last state is damaged: it does not say which optimiser wrote it")
    sigma = untag(json.loads(str(arrays["about"]))["sigma"])
    return Head("cma", f"cma=={arrays.pop('cma')}", arrays["mean"].astype(np.float64), float(sigma))
