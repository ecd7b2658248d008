"""The verbs that make a preset's world model, in order, for all of its drives and updates or a share of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from dreamfleet.common.cli import model_commands
from dreamfleet.common.cli.model_commands import Words, options, split_flags
from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.host.processes import shell_command
from dreamfleet.worker.training.assemble import load_quality
from dreamfleet.worker.training.checkpoint import load_progress
from dreamfleet.worker.training.presets import TrainConfig, TrainingPreset
from dreamfleet.worker.training.train_vae import CHECKPOINT

COLLECT, VAE, ENCODE, MDNRNN, BUNDLE = STAGES = ("collect", "train.vae", "encode", "train.mdnrnn", "bundle")
RESERVED_FLAGS = (
    "--data",
    "--preset",
    "--seed",
    "--json",
    "--new",
    "--summary",
    "--from-run",
    "--out",
)  # set for each stage
LEAST_DRIVES = 2  # one for training, one held out
MORE = 4  # times as many updates as the VAE had are advised where it learnt too little


@dataclass(frozen=True)
class Pipeline:
    """A preset's stages in a data folder. Each verb resumes by itself, so the pipeline keeps no state of its own."""

    preset: TrainingPreset
    data: Path
    scale: float = 1.0  # share of the drives, of each training's updates, and of those between its checkpoints
    seed: int = 0
    world_flags: Words = ()  # of collect: which world a new data set is of
    collect_flags: str = ""
    vae_flags: str = ""
    mdnrnn_flags: str = ""
    bundle_flags: str = ""

    def __post_init__(self) -> None:
        if not 0 < self.scale <= 1:
            raise UsageError(f"--scale must be above 0, to 1, not {self.scale:g}")

    @property
    def bundle(self) -> Path:
        """Where the world model is written by default."""
        return self.data / f"{self.preset.name}.zip"

    def stages(self, jobs: int, device: str, out: Path | None = None) -> dict[str, Words]:
        """The command line of each stage."""
        preset, drives = self.preset.name, self._scale(self.preset.collect.episodes, LEAST_DRIVES)
        collect_flags = self._split_flags("collect_flags")
        train = partial(model_commands.train, seed=self.seed, preset=preset, device=device)
        return {
            COLLECT: model_commands.collect(
                self.data, *self.world_flags, *collect_flags, preset=preset, seed=self.seed, episodes=drives, jobs=jobs
            ),
            VAE: train("vae", self.data, *self._train_flags(self.preset.vae, "vae_flags")),
            ENCODE: model_commands.encode(self.data),
            MDNRNN: train("mdnrnn", self.data, *self._train_flags(self.preset.mdnrnn, "mdnrnn_flags")),
            BUNDLE: model_commands.bundle(self.data, out or self.bundle, *self._split_flags("bundle_flags")),
        }

    def check_vae(self) -> None:
        """`DreamfleetError` where the VAE is no better than the mean picture: an MDN-RNN would learn nothing."""
        figures = load_quality(self.data)
        error, mean = figures["reconstruction_error"], figures["mean_picture_error"]
        if error >= mean:
            updates = load_progress(self.data / CHECKPOINT)["update"]
            more = shell_command("train", "vae", "--data", self.data, "--updates", MORE * updates)
            raise DreamfleetError(
                f"the VAE in {self.data} is no better than the mean picture (squared error {error:g}, not below "
                f"{mean:g}) after {updates:,} updates: train it longer with `{more}`, then give this command again; "
                "--yes goes on with it"
            )

    def _train_flags(self, config: TrainConfig, name: str) -> Words:
        """Updates, and those between checks on held-out drives, by scale: so there are as many checks at any scale."""
        updates, between = self._scale(config.updates), self._scale(config.validate_every)
        return (*options(updates=updates, validate_every=between), *self._split_flags(name))

    def _split_flags(self, name: str) -> Words:
        return split_flags(f"--{name.replace('_', '-')}", getattr(self, name), "pipeline", RESERVED_FLAGS)

    def _scale(self, amount: int, least: int = 1) -> int:
        return max(least, math.ceil(round(amount * self.scale, 6)))
