"""Checkpoints as safetensors: weights, Adam's moments, and how far training has come. No pickle."""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.host.stop_signals import signals_deferred
from dreamfleet.common.schema.validation import MalformedError, from_plain, to_plain
from dreamfleet.worker.training.data.data_folder import explain_write_errors

T = TypeVar("T")


def save_checkpoint(path: Path, model: torch.nn.Module, optimiser: torch.optim.Adam, progress: dict[str, Any]) -> None:
    """Write a checkpoint atomically; `progress` must be JSON, and the model has a `config`.

    Signals wait until it is written. `DatasetError` if it cannot be written; the last checkpoint then stays.
    """
    tensors = {f"model.{name}": tensor for name, tensor in model.state_dict().items()}
    for index, state in optimiser.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{name}": torch.as_tensor(value) for name, value in state.items()}
    about = {"progress": json.dumps(progress), "config": json.dumps(to_plain(model.config))}
    with signals_deferred(), explain_write_errors(path), atomic_write(path) as file:
        file.write(save({name: tensor.contiguous() for name, tensor in tensors.items()}, about))


def load_checkpoint(
    path: Path, model: torch.nn.Module, optimiser: torch.optim.Adam | None, extensible: frozenset[str] = frozenset()
) -> dict[str, Any] | None:
    """Restore model and optimiser from a checkpoint and return its progress; `None` if there is none yet.

    The model may set fields in `extensible` that the checkpoint's model lacks. Rows that they add to a tensor keep the
    new model's initial values, and Adam's moments of that tensor start at zero.
    """
    if not path.exists():
        return None
    check_config(path, model.config, extensible)
    try:
        with safe_open(path, "pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
            progress: dict[str, Any] = json.loads(file.metadata()["progress"])
        weights, moments = _select_prefix(tensors, "model."), _select_prefix(tensors, "adam.")
        if extensible and load_config(path, type(model.config)) != model.config:
            grown = _add_rows(weights, model)
            moments = {name: tensor for name, tensor in moments.items() if int(name.partition(".")[0]) not in grown}
        model.load_state_dict(weights)
        if optimiser is not None:
            _restore_adam(optimiser, moments)
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, RecursionError, SafetensorError) as error:
        raise DatasetError(f"checkpoint {path} does not fit or is damaged ({error}); {_remedy(path)}") from error
    return progress


def load_config(path: Path, kind: type[T]) -> T:
    """Load the configuration of a checkpoint's model."""
    return _read_metadata(path, "config", lambda plain: from_plain(kind, plain))


def load_progress(path: Path) -> dict[str, Any]:
    """Load a checkpoint's progress."""
    return _read_metadata(path, "progress", lambda plain: plain)


def _remedy(path: Path) -> str:
    """What to do about a checkpoint that cannot be used: only one that is surely ours may be deleted."""
    with suppress(OSError, SafetensorError), safe_open(path, "np") as file:
        if "progress" in (file.metadata() or {}):
            return "delete it, or give --new to start over"
    return "if another program wrote it, choose another --data; else move it away and train again"


def _read_metadata(path: Path, key: str, read: Callable[[Any], T]) -> T:
    try:
        with _open_checkpoint(path) as file:
            return read(json.loads((file.metadata() or {})[key]))
    except (ValueError, KeyError, TypeError, RecursionError, MalformedError, UsageError) as error:
        raise DatasetError(f"checkpoint {path} is damaged ({error}); {_remedy(path)}") from error


@contextmanager
def _open_checkpoint(path: Path) -> Iterator[Any]:
    """Open a checkpoint for NumPy; `DatasetError` if it is missing, or damaged where it is read."""
    if not path.exists():
        raise DatasetError(f"no {path}: train it by `{shell_command('train', path.stem, '--data', path.parent)}`")
    try:
        with safe_open(path, "np") as file:
            yield file
    except (OSError, SafetensorError) as error:
        raise DatasetError(f"checkpoint {path} is damaged ({error}); {_remedy(path)}") from error


def _select_prefix(tensors: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def _add_rows(weights: dict[str, torch.Tensor], model: torch.nn.Module) -> set[int]:
    """Extend tensors that are shorter than the model's by the model's rows; return the indices of those parameters."""
    own, grown = model.state_dict(), set()
    for index, (name, _) in enumerate(model.named_parameters()):
        if name in weights and len(weights[name]) < len(own[name]):
            weights[name] = torch.cat([weights[name], own[name].cpu()[len(weights[name]) :]])
            grown.add(index)
    return grown


def check_config(path: Path, config: Any, extensible: frozenset[str] = frozenset()) -> None:
    """`DatasetError` names the fields in which a checkpoint's model differs; `extensible` ones may be newly set."""
    stored, wanted = asdict(load_config(path, type(config))), asdict(config)
    if any(stored[name] for name in extensible):  # they can be set only once
        extensible = frozenset()
    differing = [f"{name} {stored[name]}, not {value}" for name, value in wanted.items()
                 if stored[name] != value and not (name in extensible and value)]  # fmt: skip
    if differing:
        raise DatasetError(
            f"checkpoint {path} belongs to another model: {'; '.join(differing)}; give it the same flags, or --new to "
            "start over"
        )


def load_weights(path: Path) -> dict[str, NDArray[np.float32]]:
    """Load a checkpoint's weights as arrays; `DatasetError` if it is missing or damaged."""
    with _open_checkpoint(path) as file:
        names = [name for name in file.keys() if name.startswith("model.")]  # noqa: SIM118 - no mapping
        return {name.removeprefix("model."): file.get_tensor(name) for name in names}


def _restore_adam(optimiser: torch.optim.Adam, tensors: dict[str, torch.Tensor]) -> None:
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in tensors.items():
        index, key = name.split(".")
        state.setdefault(int(index), {})[key] = tensor
    optimiser.load_state_dict({**optimiser.state_dict(), "state": state})
