"""The evolved controller: its shape, how a flat vector packs it, and the formula in NumPy.

A single linear layer (Ha & Schmidhuber 2018, section 2.3): a = W [z; h] + b, which the task's world makes an action of;
its ablations see z alone, or have a layer of tanh units between.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Actions
from dreamfleet.common.artifacts.car_racing_variants import Variant
from dreamfleet.common.errors import ControllerError
from dreamfleet.common.files.archives import ArchiveLimits, read_arrays
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.serialization.optional_fields import OPTIONAL, to_dict

FORMAT = 1
_LIMITS = ArchiveLimits(64 << 20, members=8)  # 16 million parameters: no search goes as far
_TASK_DEFAULTS: dict[str, Any] = {"options": "", "version": 1}  # of tasks; written only where they differ


@dataclass(frozen=True)
class ControllerShape:
    """What a flat parameter vector means: `features` inputs to `actions` outputs, with biases.

    Linear, or through one layer of `hidden` tanh units (Ha & Schmidhuber 2018, table 2).
    """

    features: int
    actions: int = 3
    hidden: int = field(default=0, metadata=OPTIONAL)

    @property
    def layers(self) -> tuple[tuple[int, int], ...]:
        """Outputs and inputs of each layer, first to last."""
        if self.hidden:
            return (self.hidden, self.features), (self.actions, self.hidden)
        return ((self.actions, self.features),)

    @property
    def size(self) -> int:
        """Length of the flat vector: layer after layer its weights row by row, then its biases."""
        return sum(outputs * (inputs + 1) for outputs, inputs in self.layers)

    def check(self, parameters: NDArray[np.float32]) -> None:
        """`ControllerError` unless the last axis of `parameters` is `size` long."""
        if parameters.shape[-1:] != (self.size,):
            sizes = " + ".join(f"{outputs} x ({inputs} + 1 bias)" for outputs, inputs in self.layers)
            raise ControllerError(
                f"a controller of {parameters.shape[-1]} parameters does not fit: this run needs {self.size} ({sizes})"
            )

    def unpack(self, parameters: NDArray[np.float32]) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Split `(..., size)` into each layer's weights `(..., outputs, inputs)` and biases `(..., outputs)`."""
        self.check(parameters)
        layers, start = [], 0
        for outputs, inputs in self.layers:
            middle, end = start + outputs * inputs, start + outputs * (inputs + 1)
            weights = parameters[..., start:middle].reshape(*parameters.shape[:-1], outputs, inputs)
            layers.append((weights, parameters[..., middle:end]))
            start = end
        return layers


def act(
    shape: ControllerShape, parameters: NDArray[np.float32], features: NDArray[np.float32], actions: Actions
) -> Any:
    """The action of a controller `(size,)` on features `(features,)`; the reference for the ONNX graphs."""
    *before, (weights, biases) = shape.unpack(parameters)
    value = features
    for each, offsets in before:
        value = np.tanh(each @ value + offsets)
    return actions.to_action(weights @ value + biases)


@dataclass(frozen=True)
class Controller:
    """Parameters `(size,)` float32, and for which task and world model they were evolved.

    >>> from pathlib import Path
    >>> from dreamfleet import Controller, find_controller
    >>> controller = find_controller("tiny")
    >>> controller.save(Path("copy.npz"))
    >>> Controller.load(Path("copy.npz")).sha256 == controller.sha256
    True
    """

    shape: ControllerShape
    parameters: NDArray[np.float32] = field(repr=False)
    task: str
    bundle: str  # SHA-256 of the bundle's file, hexadecimal; empty where the task needs none
    provenance: dict[str, Any] = field(default_factory=dict, repr=False)
    options: str = ""  # the task's own, as its specification has them
    version: int = 1  # the task's

    def __post_init__(self) -> None:
        if self.parameters.shape != (self.shape.size,) or self.parameters.dtype != np.float32:
            raise ControllerError(
                f"a controller needs {self.shape.size} float32 parameters, "
                f"not {self.parameters.dtype} of shape {self.parameters.shape}"
            )
        if not np.isfinite(self.parameters).all():
            raise ControllerError("a controller's parameters must be finite; this one holds NaN or infinity")

    @property
    def sha256(self) -> str:
        """Hash of the parameters' little-endian bytes."""
        return hashlib.sha256(self.parameters.astype("<f4").tobytes()).hexdigest()

    @property
    def variant(self) -> Variant:
        """How it drives, of one that was evolved on a world model; `UsageError` for options that are no variant's."""
        return Variant.from_json(self.options)

    @property
    def _task_details(self) -> dict[str, Any]:
        return {"options": self.options, "version": self.version}

    def save(self, path: Path) -> None:
        """Write an `.npz` that `load` reads; whole or not at all."""
        about = {"format": FORMAT, "shape": to_dict(self.shape), "task": self.task, "bundle": self.bundle}
        about |= {name: value for name, value in self._task_details.items() if value != _TASK_DEFAULTS[name]}
        text = json.dumps({**about, "provenance": self.provenance}, sort_keys=True)
        with atomic_write(path) as file:
            np.savez(file, parameters=self.parameters, about=np.array(text))

    @classmethod
    def load(cls, path: Path) -> Controller:
        """Read a controller file; `ControllerError` says what is wrong with it."""
        try:
            arrays = read_arrays(path, _LIMITS, ("about", "parameters"))
            return cls._parse(arrays["parameters"], json.loads(str(arrays["about"])))
        except FileNotFoundError:
            raise ControllerError(f"no controller at {path}") from None
        except OSError as error:
            raise ControllerError(f"{path} is not a controller file: {error.strerror}") from error
        except ControllerError as error:
            raise ControllerError(f"{path}: {error}") from error
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ControllerError(f"{path} is not a controller file: {error}") from error

    @classmethod
    def _parse(cls, parameters: NDArray[Any], about: dict[str, Any]) -> Controller:
        """What a file's two arrays tell; whatever they are, each field is of its own type."""
        if about["format"] != FORMAT:
            raise ControllerError(f"it is of controller format {about['format']!r:.20}; this version reads {FORMAT}")
        shape = ControllerShape(**about["shape"])
        details = {name: about.get(name, value) for name, value in _TASK_DEFAULTS.items()}
        numbers = (*vars(shape).values(), details["version"])
        if not all(type(each) is int and 0 <= each < 2**31 for each in numbers):
            raise ValueError("its shape or version is no number of them")
        if not all(isinstance(each, str) for each in (about["task"], about["bundle"], details["options"])):
            raise ValueError("its task, bundle or options are no text")
        if details["options"] and not isinstance(json.loads(details["options"]), dict):
            raise ValueError("its task's options are no JSON object")
        return cls(shape, parameters, about["task"], about["bundle"], dict(about["provenance"]), **details)
