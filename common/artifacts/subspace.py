"""Fewer features for a search: what a controller sees, seen through a fixed affine map.

A linear controller on [z, h] has hundreds of weights, and a search pays for each of them, whether it matters or not.
Restricted to a subspace it moves W = W0 + C M and b = b0 + C m + c alone: M and m make a few features of what is seen,
and the coordinates C, c are what the optimiser knows of. What is published, journalled and reported are whole
parameters all the same.
"""

from __future__ import annotations

import base64
import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.archives import ArchiveLimits, read_arrays
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.printable import one_line

FORMAT = 1
_LIMITS = ArchiveLimits(16 << 20, members=8)
_MAX_WEIGHTS = 1 << 18  # of its weights: a controller's receipt holds them as text
_MAX_NAME, _MAX_REASON = 100, 200
_LARGEST = 1e6  # of a weight: features have a deviation of about 1


@dataclass(frozen=True, eq=False)
class Subspace:
    """K features of what the controllers of one world model see: `weights` (K, inputs) and `offsets` (K,), float32."""

    weights: NDArray[np.float32]
    offsets: NDArray[np.float32]
    names: tuple[str, ...]  # of the features, for people
    bundle: str  # SHA-256 of the world model

    def __post_init__(self) -> None:
        """`ValueError` for what no subspace can be."""
        features, inputs = self.weights.shape if self.weights.ndim == 2 else (0, 0)
        if not (features and inputs):
            raise ValueError(f"weights of shape {self.weights.shape} are no features of what is seen")
        if self.weights.size > _MAX_WEIGHTS:
            raise ValueError(f"it has {self.weights.size} weights, {_MAX_WEIGHTS} at most")
        if self.offsets.shape != (features,) or len(self.names) != features:
            raise ValueError(f"{features} features need as many offsets and names")
        if self.weights.dtype != np.float32 or self.offsets.dtype != np.float32:
            raise ValueError("its numbers must be float32")
        if not all((np.abs(each) <= _LARGEST).all() for each in (self.weights, self.offsets)):  # false for NaN too
            raise ValueError(f"it holds NaN, or numbers beyond {_LARGEST:g}")
        if not all(isinstance(name, str) and 0 < len(name) <= _MAX_NAME for name in (*self.names, self.bundle)):
            raise ValueError("its names, and its world model's, must be short texts")

    @cached_property
    def text(self) -> str:
        """As a journal and a receipt keep it."""
        arrays = {name: base64.b64encode(getattr(self, name).astype("<f4").tobytes()).decode()
                  for name in ("weights", "offsets")}  # fmt: skip
        return json.dumps({**arrays, "names": self.names, "bundle": self.bundle}, sort_keys=True)

    @property
    def sha256(self) -> str:
        """Hash of all that a search depends on, and of the features' names."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @classmethod
    def from_text(cls, text: str) -> Subspace:
        """Read what `text` gave; `ValueError` if it is damaged."""
        try:
            told = json.loads(text)
            weights, offsets = (np.frombuffer(base64.b64decode(told[name], validate=True), dtype="<f4")
                                for name in ("weights", "offsets"))  # fmt: skip
            shaped = weights.reshape(len(offsets), -1).astype(np.float32)
            return cls(shaped, offsets.astype(np.float32), _as_tuple(told["names"]), told["bundle"])
        except (KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"{type(error).__name__}: {error}") from error

    def save(self, path: Path, provenance: dict[str, Any]) -> None:
        """Write an `.npz` that `load` reads; whole or not at all."""
        about = {"format": FORMAT, "names": self.names, "bundle": self.bundle, "provenance": provenance}
        with atomic_write(path) as file:
            np.savez(file, weights=self.weights, offsets=self.offsets, about=json.dumps(about))

    @classmethod
    def load(cls, path: Path) -> Subspace:
        """Read what `save` wrote; `UsageError` if that is no subspace."""
        try:
            arrays = read_arrays(path, _LIMITS)
            if missing := {"weights", "offsets", "about"} - arrays.keys():
                raise ValueError(f"it has no {', '.join(sorted(missing))}")
            about = json.loads(str(arrays["about"]))
            if about["format"] is True or about["format"] != FORMAT:
                raise ValueError(f"it is of another format than {FORMAT}")
            return cls(arrays["weights"], arrays["offsets"], _as_tuple(about["names"]), about["bundle"])
        except OSError as error:
            why = f"{error.strerror or error}: name a file of `dreamfleet subspace`, or none"
            raise UsageError(f"cannot read the subspace {path}: {why}") from error
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            why = one_line(str(error))[:_MAX_REASON]
            raise UsageError(f"{path} is no subspace ({why}): `dreamfleet subspace` makes one") from error


def _as_tuple(names: Any) -> tuple[Any, ...]:
    if not isinstance(names, list):
        raise TypeError("its names are no list")
    return tuple(names)


@dataclass(frozen=True)
class SearchSpace:
    """Where a search in a subspace goes, for controllers of one shape."""

    subspace: Subspace
    shape: ControllerShape

    @property
    def dimension(self) -> int:
        """Coordinates: an output's weight of each feature and its bias; of layers behind the first each parameter."""
        outputs, inputs = self.shape.layers[0]
        return outputs * (len(self.subspace.names) + 1) + self.shape.size - outputs * (inputs + 1)

    def lift(self, origin: NDArray[np.float64], coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
        """The parameters `(..., size)` at coordinates `(..., dimension)` counted from `origin` `(size,)`.

        Sums go feature by feature, never through BLAS, so that every host has the same bits.
        """
        outputs, inputs = self.shape.layers[0]
        features, before = len(self.subspace.names), coordinates.shape[:-1]
        first = outputs * (features + 1)
        own = coordinates[..., :first].reshape(*before, outputs, features + 1)
        rows = np.concatenate([self.subspace.weights, self.subspace.offsets[:, None]], axis=1).astype(np.float64)
        moved = np.zeros((*before, outputs, inputs + 1))
        for feature, row in enumerate(rows):
            moved += own[..., feature, None] * row
        moved[..., -1] += own[..., -1]
        weights = moved[..., :-1].reshape(*before, outputs * inputs)
        lifted: NDArray[np.float64] = origin + np.concatenate(
            [weights, moved[..., -1], coordinates[..., first:]], axis=-1
        )
        return lifted
