"""The state of a training: progress, optimiser, checkpoints and loss curve, early stopping; and its device."""

import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from dreamfleet.common.errors import DatasetError, StoppedError, UsageError
from dreamfleet.common.files.tensorboard import open_event_file
from dreamfleet.common.host.stop_signals import Stop
from dreamfleet.worker.training.checkpoint import check_config, load_checkpoint, load_progress, save_checkpoint
from dreamfleet.worker.training.data.data_folder import explain_write_errors
from dreamfleet.worker.training.presets import TrainConfig


class TrainingState:
    """A training that resumes from its last checkpoint, and stops early when the held-out loss no longer improves."""

    def __init__(
        self, path: Path, model: torch.nn.Module, config: TrainConfig, episodes: int, other: Path | None = None,
        new: bool = False, extensible: frozenset[str] = frozenset(),
    ) -> None:  # fmt: skip
        """Load the checkpoint at `path`, or begin with the weights of the checkpoint `other`, or with the model's.

        `episodes` is the number to train on. `new` replaces a checkpoint at `path` rather than resume it. Fields in
        `extensible` (see `load_checkpoint`) may be added to `other`, and to `path` while it has made no update.
        """
        if new and other is not None and other.resolve() == path.resolve():
            raise UsageError(f"--new replaces {path}, which --continue-from names: omit one of the two")
        self._path, self._model, self._config, self._episodes, self._new = path, model, config, episodes, new
        self._best_path = path.with_suffix(".best.safetensors")
        disable_triton_after_mesa()
        self.optimiser = torch.optim.Adam(model.parameters(), lr=config.rate)
        self.progress: dict[str, Any] = {"update": 0}
        begun = not new and path.exists() and load_progress(path).get("update") != 0
        if not new and (found := load_checkpoint(path, model, self.optimiser, frozenset() if begun else extensible)):
            self.progress = found
            if (own := found.get("seed", config.seed)) != config.seed:
                raise UsageError(
                    f"{path} was begun with --seed {own}, and this is --seed {config.seed}: give --seed {own} to "
                    "continue it. For another training choose another --data, or start over with --new"
                )
        elif other is not None and load_checkpoint(other, model, self.optimiser, extensible) is None:
            raise UsageError(f"--continue-from: no checkpoint at {other}")
        # A training that stopped early resumes only with other data, or with patience 0.
        if self.progress.get("stopped") not in (None, episodes) or not config.patience:
            self.progress |= {"stopped": None, "idle": 0}
        self.progress["seed"] = config.seed
        if new:
            self._replace(other)

    @property
    def update(self) -> int:
        """The number of updates made."""
        return int(self.progress["update"])

    @property
    def done(self) -> bool:
        """Whether no more updates are to be made."""
        return self.update >= self._config.updates or self.progress.get("stopped") is not None

    def should_continue(self, stop: Stop) -> bool:  # docs/explanation/determinism.md
        """Whether to make another update; if `stop` asks for a stop, save and raise `StoppedError`.

        It stops between updates only, so that a resumed training gives the same weights as an uninterrupted one.
        """
        if self.done:
            return False
        if stop():
            self.save()
            raise StoppedError(
                f"stopped after update {self.update} of {self._config.updates}: {self._path} keeps them; "
                f"{resume_command(self._new)} continues from there"
            )
        return True

    def set_rate(self, epoch: int) -> None:
        """Set the learning rate of an epoch."""
        for group in self.optimiser.param_groups:
            group["lr"] = self._config.rate * self._config.decay**epoch

    def step(self, loss: float) -> None:
        """Make an update from the present gradients; `DatasetError` if their loss is NaN or infinite."""
        if not math.isfinite(loss):
            raise DatasetError(
                f"the loss of update {self.update + 1} is {loss}: the data holds NaN or the rate is too high; what was "
                f"saved last in {self._path} is kept"
            )
        if self._config.clip:
            torch.nn.utils.clip_grad_norm_(self._model.parameters(), self._config.clip)
        self.optimiser.step()
        self.optimiser.zero_grad()
        self.progress["update"] += 1

    def save(self, path: Path | None = None) -> None:
        """Write the present state to `path`, by default the training's checkpoint."""
        save_checkpoint(path or self._path, self._model, self.optimiser, self.progress)

    def finish_update(self, validate: Callable[[], float]) -> None:
        """End an update: if due, `validate` on held-out rollouts and save; restore the best state if patience is over.

        The last checkpoint is written last and once, so that a kill before it leads to the same files again.
        """
        due = self.update % self._config.validate_every == 0 or self.update == self._config.updates
        better = due and self._record_held_out_loss(validate())
        if self._config.keep_every and self.update % self._config.keep_every == 0:
            self.save(numbered_path(self._path, self.update))
        if not due:
            return
        if better and self._config.patience:
            self.save(self._best_path)
        if 0 < self._config.patience <= self.progress["idle"]:
            update = self.update
            best = load_checkpoint(self._best_path, self._model, self.optimiser) or {}
            self.progress = {**best, "stopped": self._episodes, "idle": 0, "given_up_at": update}
        self.save()

    def _record_held_out_loss(self, loss: float) -> bool:
        """Record a held-out loss; return whether it is the best one so far with a saved state."""
        better = loss < self.progress.get("best", math.inf) or (
            self._config.patience > 0 and not self._has_best_checkpoint()
        )
        self.progress |= {"best": loss, "idle": 0} if better else {"idle": self.progress.get("idle", 0) + 1}
        return better

    def _has_best_checkpoint(self) -> bool:
        """Whether the saved best state is this training's; without patience none is saved."""
        try:
            return bool(load_progress(self._best_path).get("best") == self.progress.get("best"))
        except DatasetError:  # missing or damaged
            return False

    def _replace(self, other: Path | None) -> None:
        """Write the first checkpoint, then delete the files of the replaced training, except `other`."""
        self.save()
        kept = self._path.parent.glob(f"{self._path.stem}.[0-9]*.safetensors")
        for each in (self._best_path, self._path.with_suffix(".jsonl"), *kept):
            if other is None or each.resolve() != other.resolve():
                each.unlink(missing_ok=True)


def numbered_path(path: Path, update: int) -> Path:
    """The path of the kept checkpoint of an update, beside the last one at `path`."""
    return path.with_name(f"{path.stem}.{update:06d}{path.suffix}")


def resume_command(new: bool) -> str:
    """Describe the command that resumes a training."""
    return "the same command without --new" if new else "the same command"


def select_device(name: str) -> torch.device:
    """The device `cpu`, `cuda`, or `auto` (cuda if available); `UsageError` for an unavailable or unknown one."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise UsageError("--device cuda: torch sees no CUDA device here; use cpu or auto")
    if name not in ("cpu", "cuda"):
        raise UsageError(f"--device must be cpu, cuda or auto, not {name!r}")
    return torch.device(name)


def summarise_model(model: torch.nn.Module, other: Path | None = None, extensible: frozenset[str] = frozenset()) -> str:
    """Format the layers and their trainable parameters; `DatasetError` if the checkpoint `other` differs."""
    if other is not None:
        check_config(other, model.config, extensible)
    rows = []
    for name, module in model.named_modules():
        learnt = [each for each in module.parameters(recurse=False) if each.requires_grad]
        if learnt:
            count, shapes = sum(each.numel() for each in learnt), ", ".join(str(tuple(each.shape)) for each in learnt)
            rows.append(f"{name:<14} {type(module).__name__:<16} {count:>10,}  {shapes}")
    return "\n".join([*rows, f"{'in all':<31} {count_parameters(model):>10,}"])


def count_parameters(model: torch.nn.Module) -> int:
    """The number of trainable parameters."""
    return sum(each.numel() for each in model.parameters() if each.requires_grad)


def disable_triton_after_mesa(maps: Path = Path("/proc/self/maps")) -> None:  # docs/explanation/decisions.md
    """Prevent torch from importing triton in a process that has loaded Mesa, where that import crashes.

    Torch's optimisers import triton if it is installed, as in torch's CUDA builds. Triton brings its own LLVM, whose
    start-up code clashes with the symbols of Mesa's. Nothing here compiles models, so triton is not needed.
    """
    try:
        drawn = "libLLVM" in maps.read_text()
    except OSError:  # not Linux
        return
    if drawn and "triton" not in sys.modules:
        sys.modules["triton"] = None  # type: ignore[assignment] # makes its import raise ModuleNotFoundError


AddPoint = Callable[..., None]  # `point(update=120, error=0.3)`


@contextmanager
def open_loss_curve(path: Path, events: Path | None, update: int) -> Iterator[AddPoint]:
    """Yield a function that appends points to the curve; `events` is a folder for TensorBoard events, or `None`.

    The training resumes after `update`: events beyond it are superseded. `MissingExtraError` if events cannot be
    written.
    """
    if events is None:
        yield lambda **values: append_point(path, **values)
        return
    with open_event_file(events / path.stem, since=update + 1) as file:

        def point(*, update: int, **values: float) -> None:
            append_point(path, update=update, **values)
            file.add(update, **{f"loss__{name}": value for name, value in values.items()})

        yield point


def append_point(path: Path, **values: float) -> None:
    """Append a point as a line of JSON, whole or not at all; `DatasetError` if it cannot be written."""
    line = (json.dumps({name: round(value, 6) for name, value in values.items()}) + "\n").encode()
    with explain_write_errors(path), path.open("ab", buffering=0) as file:
        end = file.seek(0, 2)
        try:
            while line:
                line = line[file.write(line) :]
        except OSError:
            file.truncate(end)
            raise
