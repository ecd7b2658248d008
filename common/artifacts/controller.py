"""The evolved controller: its shape, its flat parameter vector, and its formula in NumPy.

A linear layer on the world model's latent z and hidden state h (Ha & Schmidhuber 2018, section 2.3): W [z; h] + b,
which the task converts to an action. Variants see z alone, or have a layer of tanh units between. Pages: security.md.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Actions
from dreamfleet.common.artifacts.driving import Variant
from dreamfleet.common.errors import ControllerError, MissingExtraError
from dreamfleet.common.files.archives import ArchiveLimits, read_arrays
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.host.packages import install_command_for
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.printable import plural
from dreamfleet.common.schema.display import Displayed
from dreamfleet.common.schema.validation import OPTIONAL, to_plain

if TYPE_CHECKING:
    from dreamfleet.common.artifacts.bundle import Bundle

FORMAT = 1
IMPORTED = "imported"  # in the provenance: the name of another program's file
PREDICTORS = "dreamfleet.predictors"  # entry points: what makes a `Predictor` of a controller, on hosts that score
_LIMITS = ArchiveLimits(64 << 20, members=8)  # 16 million parameters, more than any search has; client.py has it too
_TASK_DEFAULTS: dict[str, Any] = {"options": "", "version": 1}  # written only where a task's values differ


@dataclass(frozen=True)
class ControllerShape:
    """The layout of a flat parameter vector: `features` inputs to `actions` outputs, with biases.

    Linear, or with one layer of `hidden` tanh units (Ha & Schmidhuber 2018, table 2).

    >>> from dreamfleet import ControllerShape
    >>> ControllerShape(features=4, actions=2).size, ControllerShape(4, 2, hidden=8).size
    (10, 58)
    """

    features: int
    actions: int
    hidden: int = field(default=0, metadata=OPTIONAL)

    @property
    def layers(self) -> tuple[tuple[int, int], ...]:
        """Numbers of outputs and inputs of each layer, first to last."""
        if self.hidden:
            return (self.hidden, self.features), (self.actions, self.hidden)
        return ((self.actions, self.features),)

    @property
    def size(self) -> int:
        """Length of the flat vector; it holds each layer's weights row by row, then its biases."""
        return sum(outputs * (inputs + 1) for outputs, inputs in self.layers)

    def check(self, parameters: NDArray[np.float32]) -> None:
        """`ControllerError` unless the last axis of `parameters` is `size` long."""
        if parameters.shape[-1:] != (self.size,):
            sizes = " + ".join(f"{outputs} x ({inputs} + 1 bias)" for outputs, inputs in self.layers)
            raise ControllerError(
                f"a controller of {plural(parameters.shape[-1], 'parameter')} does not fit: this run needs "
                f"{self.size} ({sizes})"
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
    """The action of a controller `(size,)` for features `(features,)`: the reference for the ONNX graphs."""
    *before, (weights, biases) = shape.unpack(parameters)
    value = features
    for hidden_weights, hidden_biases in before:
        value = np.tanh(hidden_weights @ value + hidden_biases)
    return actions.to_action(weights @ value + biases)


class Predictor(Protocol):
    """A controller with all that it needs to act."""

    def predict(self, observation: Any, state: Any, reward: float | None) -> tuple[Any, Any]:
        """As `Controller.predict`."""


@dataclass(frozen=True, repr=False)
class Controller(Displayed):
    """Parameters `(size,)` float32, with the task and world model that they were evolved for.

    `predict` acts; `save` and `load` are for files.

    >>> from pathlib import Path
    >>> from dreamfleet import Controller, find_controller
    >>> controller = find_controller("tiny")
    >>> controller.save(Path("copy.npz"))
    >>> Controller.load(Path("copy.npz")).sha256 == controller.sha256
    True
    >>> controller
    <Controller of dream: 867 parameters, 288 inputs to 3 outputs, SHA-256 e987f25edac2>
    """

    shape: ControllerShape
    parameters: NDArray[np.float32]
    task: str
    bundle: str  # SHA-256 of the bundle's file, hexadecimal; empty if the task needs none
    provenance: dict[str, Any] = field(default_factory=dict)
    options: str = ""  # the task's options as in its specification
    version: int = 1  # of the task

    def __post_init__(self) -> None:
        if self.parameters.shape != (self.shape.size,) or self.parameters.dtype != np.float32:
            raise ControllerError(
                f"a controller needs {self.shape.size} float32 parameters, "
                f"not {self.parameters.dtype} of shape {self.parameters.shape}"
            )
        if not np.isfinite(self.parameters).all():
            raise ControllerError("a controller's parameters must be finite; this one holds NaN or infinity")

    def _display(self) -> tuple[str, dict[str, object]]:
        shape, digest = self.shape, self.sha256[:12]
        layers = f"{shape.features} inputs to {shape.actions} outputs"
        layers += f" through {shape.hidden} tanh units" if shape.hidden else ""
        facts = {
            "task": self.task,
            "parameters": shape.size,
            "layers": layers,
            "world model": self.bundle[:12] or "none",
            "options": self.options or None,
            "from generation": self.provenance.get("generation"),
            "SHA-256": digest,
        }
        return f"Controller of {self.task}: {plural(shape.size, 'parameter')}, {layers}, SHA-256 {digest}", facts

    @property
    def sha256(self) -> str:
        """Hash of the parameters' little-endian bytes."""
        return hashlib.sha256(self.parameters.astype("<f4").tobytes()).hexdigest()

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: bool = False,
        deterministic: bool = True,  # noqa: ARG002 - the order of Stable-Baselines; a controller has no randomness
        *,
        reward: float | None = None,
        bundle: Bundle | None = None,
    ) -> tuple[Any, Any]:
        """The action for one observation, and the recurrent state to pass to the next call.

        Arguments are in the order of Stable-Baselines. Without `state`, or with `episode_start`, an episode begins. A
        controller with a world model encodes the picture and remembers; the state of one without is `None`. `reward` is
        that of the last action, which some world models look at. `bundle` is the world model, where it neither ships
        nor is cached; the first call loads it. `MissingExtraError` on a host without the packages of a worker;
        `ControllerError` for the state of another controller.

        >>> from dreamfleet import find_controller, make_environment
        >>> controller = find_controller("tiny")
        >>> environment = make_environment(controller)
        >>> observation, info = environment.reset(seed=1)
        >>> state, reward = None, None
        >>> for _ in range(3):
        ...     action, state = controller.predict(observation, state, reward=reward)
        ...     observation, reward, terminated, truncated, info = environment.step(action)
        >>> environment.close()
        """
        if "_predictor" not in self.__dict__:
            object.__setattr__(self, "_predictor", _load_predictor(self, bundle))
        predictor: Predictor = self.__dict__["_predictor"]
        return predictor.predict(observation, None if episode_start else state, reward)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_predictor"}

    @property
    def variant(self) -> Variant:
        """The variant of CarRacing in the options; `UsageError` if they name none."""
        return Variant.from_json(self.options)

    def save(self, path: Path | str) -> None:
        """Write an `.npz` that `load` reads, atomically."""
        about = {"format": FORMAT, "shape": to_plain(self.shape), "task": self.task, "bundle": self.bundle}
        about |= {name: own for name, default in _TASK_DEFAULTS.items() if (own := getattr(self, name)) != default}
        text = json.dumps({**about, "provenance": self.provenance}, sort_keys=True)
        with atomic_write(Path(path)) as file:
            np.savez(file, parameters=self.parameters, about=np.array(text))

    @classmethod
    def load(cls, path: Path) -> Controller:
        """Read a controller file; `ControllerError` describes what is wrong with it."""
        try:
            arrays = read_arrays(path, _LIMITS, ("about", "parameters"))
            return cls._parse(arrays["parameters"], json.loads(str(arrays["about"])))
        except FileNotFoundError:
            raise ControllerError(f"no controller at {path}") from None
        except OSError as error:
            raise ControllerError(f"{path} is not a controller file: {error.strerror}; {import_hint(path)}") from error
        except ControllerError as error:
            raise ControllerError(f"{path}: {error}") from error
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            reason = f": {error}" if path.suffix.lower() in ("", ".npz") else ""
            agent = "; `evaluate`, `record` and `verify report` play a trained agent" * (path.suffix.lower() == ".zip")
            raise ControllerError(f"{path} is not a controller file{reason}; {import_hint(path)}{agent}") from error

    @classmethod
    def _parse(cls, parameters: NDArray[Any], about: dict[str, Any]) -> Controller:
        """Build a controller from a file's two arrays, of which nothing is trusted."""
        if about["format"] != FORMAT:
            raise ControllerError(f"it has controller format {about['format']!r:.20}; this version reads {FORMAT}")
        shape = ControllerShape(**about["shape"])
        details = {name: about.get(name, value) for name, value in _TASK_DEFAULTS.items()}
        numbers = (*vars(shape).values(), details["version"])
        if not all(type(each) is int and 0 <= each < 2**31 for each in numbers):
            raise ValueError("its shape or version is not a whole number")
        if not all(isinstance(each, str) for each in (about["task"], about["bundle"], details["options"])):
            raise ValueError("its task, bundle or options are not text")
        if details["options"] and not isinstance(json.loads(details["options"]), dict):
            raise ValueError("its task's options are not a JSON object")
        return cls(shape, parameters, about["task"], about["bundle"], dict(about["provenance"]), **details)


def import_hint(source: Path, *to: object) -> str:
    """The command that makes something of what another program wrote; by default a controller, of .npz what it is."""
    vector = ("--bundle", "WORLD_MODEL", "--out", "controller.npz")
    into = to or (("--out", "OUT") if source.suffix.lower() == ".npz" else vector)
    return f"`{shell_command('import', source, *into)}` reads what another program wrote"


def _load_predictor(controller: Controller, bundle: Bundle | None) -> Predictor:
    """What acts for the controller, which only the worker's side can make: this side knows no simulator."""
    try:
        (point,) = entry_points(group=PREDICTORS, name="worker")
        found: Predictor = point.load()(controller, bundle)
    except ModuleNotFoundError as error:
        remedy = install_command_for(error.name) or "install the package that has it"
        raise MissingExtraError(f"predict needs the package {error.name!r}: {remedy}") from error
    return found
