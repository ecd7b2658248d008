"""When training ends, at which rate it learns, and on what."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from dreamfleet.common.errors import DatasetError, StoppedError, UsageError
from dreamfleet.common.host.stop_signals import Stop
from dreamfleet.worker.training.checkpoint import (
    check_config,
    load_checkpoint,
    load_progress,
    save_checkpoint,
)
from dreamfleet.worker.training.presets import TrainConfig


class TrainingState:
    """A training's progress on disk: goes on where it stopped, and ends early when held-out rollouts gain nothing."""

    def __init__(
        self, path: Path, model: torch.nn.Module, config: TrainConfig, episodes: int, other: Path | None = None,
        new: bool = False, extensible: frozenset[str] = frozenset(),
    ) -> None:  # fmt: skip
        """`episodes` to train on, in all; `other` is a checkpoint to begin from where `path` has none.

        `new`: what `path` has is not gone on with, and replaced. What is `extensible` of the configuration, as for
        `load_checkpoint`, is so of `other`, and of what `path` has while it has made no update.
        """
        if new and other is not None and other.resolve() == path.resolve():
            raise UsageError(f"--new replaces {path}, which --continue-from names: leave one of the two out")
        self._path, self._model, self._config, self._episodes, self._new = path, model, config, episodes, new
        self._best_path = path.with_suffix(".best.safetensors")
        disable_triton_after_mesa()
        self.optimiser = torch.optim.Adam(model.parameters(), lr=config.rate)
        self.progress: dict[str, Any] = {"update": 0}
        begun = not new and path.exists() and load_progress(path).get("update") != 0
        if not new and (found := load_checkpoint(path, model, self.optimiser, frozenset() if begun else extensible)):
            self.progress = found
            _check_seed(path, found.get("seed", config.seed), config.seed)
        elif other is not None and load_checkpoint(other, model, self.optimiser, extensible) is None:
            raise UsageError(f"--continue-from: no checkpoint at {other}")
        # Ended early: only something new to learn from, or no patience at all, makes it go on.
        if self.progress.get("stopped") not in (None, episodes) or not config.patience:
            self.progress |= {"stopped": None, "idle": 0}
        self.progress["seed"] = config.seed
        if new:
            self._replace(other)

    @property
    def update(self) -> int:
        """Updates made."""
        return int(self.progress["update"])

    @property
    def done(self) -> bool:
        """Whether to make no more updates."""
        return self.update >= self._config.updates or self.progress.get("stopped") is not None

    def should_continue(self, stop: Stop) -> bool:
        """Whether to make another update; `StoppedError` between two of them, the last one saved, if told to stop.

        Between two updates, because what a stop keeps must lead to the weights that no stop would have led to.
        """
        if self.done:
            return False
        if stop():
            self.save()
            raise StoppedError(
                f"stopped after update {self.update} of {self._config.updates}: {self._path} keeps them; "
                f"{resume_command(self._new)} goes on from there"
            )
        return True

    def set_rate(self, epoch: int) -> None:
        """The rate of an epoch."""
        for group in self.optimiser.param_groups:
            group["lr"] = self._config.rate * self._config.decay**epoch

    def step(self, loss: float) -> None:
        """One update from the gradients as they are; `DatasetError` where the loss they are of is no number."""
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
        """Keep the present state."""
        save_checkpoint(path or self._path, self._model, self.optimiser, self.progress)

    def finish_update(self, validate: Callable[[], float]) -> None:
        """End an update: where it is due, `validate` on held-out rollouts and save; the best, if patience is over.

        The last checkpoint is written last and once: a kill before it leads to the same files again.
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
            self._stop_early()
        self.save()

    def _record_held_out_loss(self, loss: float) -> bool:
        """Take a held-out loss; whether it is the best so far, of those whose state is there to end with."""
        better = loss < self.progress.get("best", math.inf) or (
            self._config.patience > 0 and not self._has_best_checkpoint()
        )
        self.progress |= {"best": loss, "idle": 0} if better else {"idle": self.progress.get("idle", 0) + 1}
        return better

    def _stop_early(self) -> None:
        update = self.update
        best = load_checkpoint(self._best_path, self._model, self.optimiser) or {}
        self.progress = {**best, "stopped": self._episodes, "idle": 0, "given_up_at": update}

    def _has_best_checkpoint(self) -> bool:
        """Whether the best state lies there; without patience it was not kept, or it is another training's."""
        try:
            return bool(load_progress(self._best_path).get("best") == self.progress.get("best"))
        except DatasetError:  # it is not there, or damaged
            return False

    def _replace(self, other: Path | None) -> None:
        """Write the first checkpoint where one may lie; only then remove what belongs to that, except `other`."""
        self.save()
        kept = self._path.parent.glob(f"{self._path.stem}.[0-9]*.safetensors")
        for each in (self._best_path, self._path.with_suffix(".jsonl"), *kept):
            if other is None or each.resolve() != other.resolve():
                each.unlink(missing_ok=True)


def _check_seed(path: Path, own: Any, given: int) -> None:
    """`UsageError` where a training would go on by another seed than it was begun with."""
    if own != given:
        raise UsageError(
            f"{path} was begun with --seed {own}, and this is --seed {given}: give --seed {own} to go on with it; "
            "another training is one in another --data, or begins anew with --new"
        )


def numbered_path(path: Path, update: int) -> Path:
    """Where the checkpoint of an update is kept beside the last one, which lies at `path`."""
    return path.with_name(f"{path.stem}.{update:06d}{path.suffix}")


def resume_command(new: bool) -> str:
    """What goes on with a training."""
    return "the same command without --new" if new else "the same command"


def select_device(name: str) -> torch.device:
    """`cpu`, `cuda`, or `auto`: cuda where there is one."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise UsageError("--device cuda: torch sees no CUDA device here; use cpu or auto")
    if name not in ("cpu", "cuda"):
        raise UsageError(f"--device must be cpu, cuda or auto, not {name!r}")
    return torch.device(name)


def summarise_model(model: torch.nn.Module, other: Path | None = None, extensible: frozenset[str] = frozenset()) -> str:
    """Layers and how many parameters of each are learnt; `DatasetError` if `other` is of another model."""
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
    """How many numbers a training changes."""
    return sum(each.numel() for each in model.parameters() if each.requires_grad)


def disable_triton_after_mesa(maps: Path = Path("/proc/self/maps")) -> None:
    """Let torch do without triton in a process that has drawn through Mesa: to load it there crashes.

    An optimiser of torch imports triton wherever it is installed, which is in torch's CUDA builds. Triton carries an
    LLVM of its own, whose start-up code meets the symbols of Mesa's. Nothing here compiles models, so it is not missed.
    """
    try:
        drawn = "libLLVM" in maps.read_text()
    except OSError:  # not Linux
        return
    if drawn and "triton" not in sys.modules:
        sys.modules["triton"] = None  # type: ignore[assignment] # what an import of it meets: ModuleNotFoundError
