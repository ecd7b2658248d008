"""How a model is trained."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError


def required(text: str) -> Any:
    """A field without a default, and the text that `--help` shows."""
    return field(metadata={"help": text})


@dataclass(frozen=True)
class TrainConfig:
    """One model's training: Adam at `rate`, `updates` of `batch` pictures or episodes."""

    updates: int = required("updates in all, those that are made already among them")
    batch: int = required("pictures, or drives, of an update")
    rate: float = required("Adam's learning rate")
    clip: float = option(1.0, "norm of the gradients at most; 0: any")
    seed: int = option(0, "makes the training: first weights, batches and chance follow from it")
    decay: float = option(1.0, "of the rate, an epoch: as many updates as show every recorded frame or drive once")
    patience: int = option(0, "validations without a better held-out loss before training ends; 0: never")
    validate_every: int = option(200, "updates after which held-out drives are looked at, and a checkpoint is written")
    keep_every: int = option(
        0, "updates after which a checkpoint stays beside the last one, as vae.000400.safetensors; 0: none"
    )

    def __post_init__(self) -> None:
        for name in ("updates", "batch", "validate_every"):
            if getattr(self, name) < 1:
                raise UsageError(f"--{name.replace('_', '-')} must be at least 1, not {getattr(self, name)}")
        if self.keep_every < 0:
            raise UsageError(f"--keep-every must be at least 1, or 0 for none, not {self.keep_every}")
        if not (self.rate > 0 and self.clip >= 0 and 0 < self.decay <= 1 and self.patience >= 0 and self.seed >= 0):
            raise UsageError("--rate must be positive, --decay in (0, 1], --clip, --patience and --seed not negative")
