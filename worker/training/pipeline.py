"""A whole source as the verbs that make it, in their order, or a share of it."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass
from pathlib import Path

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.training.presets import TrainConfig, TrainingPreset

Arguments = tuple[str, ...]
COLLECT, VAE, ENCODE, MDNRNN, BUNDLE = STAGES = ("collect", "train.vae", "encode", "train.mdnrnn", "bundle")
RESERVED_FLAGS = (
    "--data",
    "--preset",
    "--seed",
    "--json",
    "--new",
    "--summary",
    "--from-run",
)  # not a stage's to be given
LEAST_DRIVES = 2  # one to learn from, one that is held out


@dataclass(frozen=True)
class Pipeline:
    """A preset in a data folder. Each verb goes on where it stopped, so nothing else need be remembered."""

    preset: TrainingPreset
    data: Path
    scale: float = 1.0  # share of the drives, of each training's updates, and of those between its checkpoints
    seed: int = 0
    collect_flags: str = ""
    vae_flags: str = ""
    mdnrnn_flags: str = ""

    def __post_init__(self) -> None:
        if not 0 < self.scale <= 1:
            raise UsageError(f"--scale must be above 0, to 1, not {self.scale:g}")

    @property
    def bundle(self) -> Path:
        """Where the world model ends, if nobody says another place."""
        return self.data / f"{self.preset.name}.zip"

    def stages(self, jobs: int, device: str, out: Path | None = None) -> dict[str, Arguments]:
        """The words behind each verb; of a flag that is said twice the latter counts."""
        folder = ("--data", str(self.data))
        begun = (*folder, "--preset", self.preset.name, "--seed", str(self.seed))
        drives = self._scale(self.preset.collect.episodes, LEAST_DRIVES)
        trained = (*begun, "--device", device)
        return {
            COLLECT: (*begun, "--jobs", str(jobs), "--episodes", drives,
                      *_split_flags("--collect-flags", self.collect_flags)),
            VAE: (*trained, *self._updates(self.preset.vae), *_split_flags("--vae-flags", self.vae_flags)),
            ENCODE: folder,
            MDNRNN: (*trained, *self._updates(self.preset.mdnrnn), *_split_flags("--mdnrnn-flags", self.mdnrnn_flags)),
            BUNDLE: (*folder, "--out", str(out or self.bundle)),
        }  # fmt: skip

    def _updates(self, config: TrainConfig) -> Arguments:
        """As many looks at held-out drives, and checkpoints, at any scale; they change no weight but by patience."""
        return ("--updates", self._scale(config.updates), "--validate-every", self._scale(config.validate_every))

    def _scale(self, amount: int, least: int = 1) -> str:
        return str(max(least, math.ceil(round(amount * self.scale, 6))))


def _split_flags(flag: str, text: str) -> Arguments:
    """Flags that were given as one text; `UsageError` where its quotes do not match, or one is not to be given."""
    try:
        words = tuple(shlex.split(text))
    except ValueError as error:
        raise UsageError(f"{flag} {text!r}: {error}") from error
    said = {word.partition("=")[0] for word in words if word.startswith("--")}
    if taken := [
        each for each in RESERVED_FLAGS if any(each.startswith(word) for word in said)
    ]:  # flags may be shortened
        raise UsageError(f"{flag}: {', '.join(taken)} of a stage is the pipeline's own to give")
    return words
