"""A contrast: kinds of MDN-RNNs, seeds, and how each is trained and evolved in. Pure."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from dreamfleet.common.cli.key_values import split_flags
from dreamfleet.common.cli.presets import default_run_preset
from dreamfleet.common.errors import UsageError
from dreamfleet.experiments.iteration.config import MOST_SEED, RESERVED_FLAGS
from dreamfleet.experiments.local.command_lines import Words

# Equal parameters: 422,625 and 421,277 of 32 latents and three actions.
KINDS = (("plain", ""), ("attentive", "--set window=8 hidden=236"))
SEEDS = (1, 2, 3)
RUN_FLAGS = "--generations 32"
_NAME = re.compile(r"[a-z][a-z0-9-]{0,30}")


@dataclass(frozen=True)
class Trial:
    """One kind with one seed."""

    kind: str
    seed: int

    @property
    def name(self) -> str:
        """The name of its folder and its run."""
        return f"{self.kind}-{self.seed}"


@dataclass(frozen=True)
class Contrast:
    """Kinds by name with their flags of `train mdnrnn`, the seeds that each is trained with, and flags for all."""

    kinds: tuple[tuple[str, str], ...] = KINDS
    seeds: tuple[int, ...] = SEEDS
    mdnrnn_flags: str = ""
    run_flags: str = RUN_FLAGS

    def __post_init__(self) -> None:
        names = [name for name, _ in self.kinds]
        if len(names) < 2:
            raise UsageError("give --kind NAME FLAGS twice or more: each is compared with the first")
        for name in names:
            if not _NAME.fullmatch(name):
                raise UsageError(f"--kind {name!r}: a name has only a-z, 0-9 and '-', and begins with a letter")
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise UsageError(f"--kind {twice[0]} is given twice")
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise UsageError("--seeds must be different ones, one at least")
        if wrong := [seed for seed in self.seeds if not 0 <= seed <= MOST_SEED]:
            raise UsageError(f"--seeds must be from 0 to {MOST_SEED}, not {wrong[0]}")
        for flag, text in (
            *((f"--kind {name}", text) for name, text in self.kinds),
            ("--mdnrnn-flags", self.mdnrnn_flags),
        ):
            split_flags(flag, text, "lab contrast", RESERVED_FLAGS)

    @property
    def trials(self) -> tuple[Trial, ...]:
        """All trials, seed by seed, so that an unfinished contrast compares kinds evenly too."""
        return tuple(Trial(name, seed) for seed in self.seeds for name, _ in self.kinds)

    def training_flags(self, trial: Trial) -> Words:
        """The flags of a trial's `train mdnrnn` beside its folder and seed; of one given twice the kind's counts."""
        own = dict(self.kinds)[trial.kind]
        return (*split_flags("--mdnrnn-flags", self.mdnrnn_flags), *split_flags("--kind", own))

    def run_flags_in(self, world: str) -> Words:
        """The flags that all trials' `coordinator` have in common, in the dream of this task's world."""
        return ("--preset", default_run_preset(world), *split_flags("--run-flags", self.run_flags))

    def continue_from(self, begun: Contrast) -> Contrast:
        """The contrast of a folder that was begun with another: its kinds and seeds are added, none is changed.

        `UsageError` if its finished trials could not be compared with new ones.
        """
        known, kinds = dict(begun.kinds), dict(self.kinds)
        names: tuple[str, ...] = ("mdnrnn_flags", "run_flags")
        differing = [name for name in names if getattr(begun, name) != getattr(self, name)]
        differing += [f"kind {name}" for name, flags in known.items() if kinds.get(name, flags) != flags]
        if differing:
            raise UsageError(f"it was begun with other {', '.join(differing)}: omit that, or begin in another --out")
        seeds = tuple(dict.fromkeys((*begun.seeds, *self.seeds)))
        return replace(self, kinds=tuple((known | kinds).items()), seeds=seeds)
