"""Subspaces: a search over few features, which a fixed affine map makes of a controller's inputs.

A linear controller on [z, h] has hundreds of weights, and each costs the search evaluations. In a subspace the search
varies W = W0 + C M and b = b0 + C m + c only: M and m map the inputs to K features, and the coordinates C, c are the
optimiser's variables. Published, journalled and reported are the full parameters. Pages: optimisers.md.
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
_MAX_WEIGHTS = 1 << 18  # a controller's provenance holds the weights as text
_MAX_NAME, _MAX_REASON = 100, 200
_LARGEST = 1e6  # largest magnitude of a weight; features have a deviation of about 1


@dataclass(frozen=True, eq=False)
class Subspace:
    """K features of the inputs of one world model's controllers: `weights` (K, inputs), `offsets` (K,), float32.

    `ValueError` for arrays and names that do not fit together.
    """

    weights: NDArray[np.float32]
    offsets: NDArray[np.float32]
    names: tuple[str, ...]  # of the features, for display
    bundle: str  # SHA-256 of the world model

    def __post_init__(self) -> None:
        features, inputs = self.weights.shape if self.weights.ndim == 2 else (0, 0)
        if not (features and inputs):
            raise ValueError(f"weights of shape {self.weights.shape} must have shape (features, inputs)")
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
        """The subspace as JSON, for journals and provenance; `from_text` reads it."""
        arrays = {name: base64.b64encode(getattr(self, name).astype("<f4").tobytes()).decode()
                  for name in ("weights", "offsets")}  # fmt: skip
        return json.dumps({**arrays, "names": self.names, "bundle": self.bundle}, sort_keys=True)

    @property
    def sha256(self) -> str:
        """Hash of the whole subspace, names included."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @classmethod
    def from_text(cls, text: str) -> Subspace:
        """Parse `text`; `ValueError` if it is damaged."""
        try:
            plain = json.loads(text)
            weights, offsets = (np.frombuffer(base64.b64decode(plain[name], validate=True), dtype="<f4")
                                for name in ("weights", "offsets"))  # fmt: skip
            shaped = weights.reshape(len(offsets), -1).astype(np.float32)
            return cls(shaped, offsets.astype(np.float32), _as_tuple(plain["names"]), plain["bundle"])
        except (KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"{type(error).__name__}: {error}") from error

    def save(self, path: Path, provenance: dict[str, Any]) -> None:
        """Write an `.npz` that `load` reads, atomically."""
        about = {"format": FORMAT, "names": self.names, "bundle": self.bundle, "provenance": provenance}
        with atomic_write(path) as file:
            np.savez(file, weights=self.weights, offsets=self.offsets, about=json.dumps(about))

    @classmethod
    def load(cls, path: Path) -> Subspace:
        """Read a file that `save` wrote; `UsageError` if it is no subspace."""
        try:
            arrays = read_arrays(path, _LIMITS)
            if missing := {"weights", "offsets", "about"} - arrays.keys():
                raise ValueError(f"it has no {', '.join(sorted(missing))}")
            about = json.loads(str(arrays["about"]))
            if about["format"] is True or about["format"] != FORMAT:
                raise ValueError(f"it has another format than {FORMAT}")
            return cls(arrays["weights"], arrays["offsets"], _as_tuple(about["names"]), about["bundle"])
        except OSError as error:
            why = f"{error.strerror or error}: name a file of `dreamfleet lab subspace`, or none"
            raise UsageError(f"cannot read the subspace {path}: {why}") from error
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            why = one_line(str(error))[:_MAX_REASON]
            raise UsageError(f"{path} is not a subspace ({why}): `dreamfleet lab subspace` makes one") from error


def _as_tuple(names: Any) -> tuple[Any, ...]:
    if not isinstance(names, list):
        raise TypeError("its names are not a list")
    return tuple(names)


@dataclass(frozen=True)
class SearchSpace:
    """The coordinates of a search in a subspace, for controllers of one shape."""

    subspace: Subspace
    shape: ControllerShape

    @property
    def dimension(self) -> int:  # docs/how-to/quality-diversity.md has CarRacing's
        """Number of coordinates: K weights and a bias for each output of the first layer, and all other parameters."""
        outputs, inputs = self.shape.layers[0]
        return outputs * (len(self.subspace.names) + 1) + self.shape.size - outputs * (inputs + 1)

    def lift(self, origin: NDArray[np.float64], coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
        """The parameters `(..., size)` at coordinates `(..., dimension)` relative to `origin` `(size,)`.

        Sums run feature by feature, not through BLAS, so that every host computes the same bits.
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
