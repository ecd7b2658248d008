"""An optimiser's state as a run's journal stores it: arrays, and a head that names the optimiser."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import JournalError
from dreamfleet.common.files.archives import ArchiveLimits, read_arrays
from dreamfleet.common.printable import one_line
from dreamfleet.coordinator.optimisers.api import State

PREFIX = "optimiser."
SCALARS = (bool, int, float, str, type(None), np.bool_, np.integer, np.floating)
_LIMITS = ArchiveLimits(1 << 30, members=4096)  # bytes: more than SQLite keeps in one place


@dataclass(frozen=True)
class Head:  # docs/explanation/decisions.md
    """The name and requirement of the optimiser that wrote a state, its mean `(dimension,)` and its step size.

    A search in a subspace also has an origin `(dimension,)`, the zero of its coordinates.
    """

    name: str
    requirement: str
    mean: NDArray[np.float64]
    sigma: float
    origin: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Checkpoint:
    """A state between an update and the next `ask`. Packing it is slow, so the journal does that when it writes."""

    head: Head
    state: State

    def packed(self) -> bytes:
        """The bytes of one `.npz` archive."""
        head = {PREFIX + name: np.array(value) for name, value in vars(self.head).items() if value is not None}
        buffer = io.BytesIO()
        np.savez(buffer, **self.state, **head)  # type: ignore[arg-type]
        return buffer.getvalue()

    @classmethod
    def unpack(cls, data: bytes) -> Checkpoint:
        """Read what `packed` wrote; `JournalError` if it is damaged. Pickle is never loaded."""
        try:
            arrays = read_arrays(data, _LIMITS)
            head = {name: arrays.pop(name) for name in [*arrays] if name.startswith(PREFIX)}
            name, requirement, mean, sigma = (head[PREFIX + each] for each in ("name", "requirement", "mean", "sigma"))
            found = Head(str(name), str(requirement), mean, float(sigma), head.get(PREFIX + "origin"))
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            why = one_line(str(error))
            raise JournalError(f"the journal's last state is damaged ({why}): restore it from a copy") from error
        return cls(found, arrays)


def tag(value: Any) -> list[Any]:
    """A scalar with its type, for JSON that comes back with the same bits; floats are hexadecimal.

    The type matters because Python's float and NumPy's do not take every operation through the same routine.
    """
    if isinstance(value, (float, np.floating)):
        return [type(value).__name__, float(value).hex()]
    if isinstance(value, (np.integer, np.bool_)):
        return [type(value).__name__, value.item()]
    return ["plain", value]


def untag(tagged: list[Any]) -> Any:
    """The scalar that `tag` wrote."""
    kind, value = tagged
    if kind == "plain":
        return value
    number = float.fromhex(value) if isinstance(value, str) else value
    return number if kind == "float" else np.dtype(kind.rstrip("_")).type(number)
