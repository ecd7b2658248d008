"""What a contrast is: kinds of MDN-RNNs, seeds, and how each is trained and evolved in. Pure."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.experiments.iteration.config import RESERVED_FLAGS, split_flags

# Equal parameters: 422,625 and 421,277 of 32 latents and three actions.
KINDS = (("plain", ""), ("attentive", "--window 8 --hidden 236"))
SEEDS = (1, 2, 3)
RUN_FLAGS = "--generations 32"
_NAME = re.compile(r"[a-z][a-z0-9-]{0,30}")
MOST_SEED = 2**31 - 1


@dataclass(frozen=True)
class Trial:
    """One kind with one seed."""

    kind: str
    seed: int

    @property
    def name(self) -> str:
        """Of its folder and its run."""
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
                raise UsageError(f"--kind {name!r}: a name is of a-z, 0-9 and '-', and begins with a letter")
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
            _check_reserved(flag, text)

    @property
    def trials(self) -> tuple[Trial, ...]:
        """All of them, seed by seed: what is there after any of them compares kinds as evenly as can be."""
        return tuple(Trial(name, seed) for seed in self.seeds for name, _ in self.kinds)

    def training_flags(self, trial: Trial) -> tuple[str, ...]:
        """The flags of a trial's `train mdnrnn` but for its folder; of one that is said twice the latter counts."""
        own = dict(self.kinds)[trial.kind]
        return (*split_flags("mdnrnn_flags", self.mdnrnn_flags), *split_flags("kind", own), "--seed", str(trial.seed))

    @property
    def common_run_flags(self) -> tuple[str, ...]:
        """What all trials' `coordinator` have in common."""
        return ("--preset", "dream", *split_flags("run_flags", self.run_flags))

    def evolution_flags(self, trial: Trial) -> tuple[str, ...]:
        """The flags of a trial's `coordinator` but for its place and its world model."""
        return (*self.common_run_flags, "--seed", str(trial.seed))

    def merge_settings(self, told: dict[str, Any]) -> dict[str, Any]:
        """What a folder keeps that was begun by `told` and goes on by this: kinds and seeds are added, none is changed.

        `UsageError` if what is there already could not be compared with this.
        """
        mine, kinds, known = asdict(self), dict(self.kinds), dict(told.get("kinds", ()))
        differing: list[str] = [
            name for name in ("mdnrnn_flags", "run_flags") if name in told and told[name] != mine[name]
        ]
        differing += [f"kind {name}" for name, flags in known.items() if kinds.get(name, flags) != flags]
        if differing:
            raise UsageError(
                f"it was begun with other {', '.join(differing)}: leave that out, or begin in another --out"
            )
        seeds = tuple(dict.fromkeys((*told.get("seeds", ()), *self.seeds)))
        return {**mine, "kinds": tuple((known | kinds).items()), "seeds": seeds}


def _check_reserved(flag: str, text: str) -> None:
    said = {word.partition("=")[0] for word in split_flags(flag.lstrip("-"), text) if word.startswith("--")}
    if taken := [
        each for each in RESERVED_FLAGS if any(each.startswith(word) for word in said)
    ]:  # flags may be shortened
        raise UsageError(f"{flag}: {', '.join(taken)} of each training is contrast's own to give")


def parse_kinds(given: Sequence[Sequence[str]]) -> tuple[tuple[str, str], ...]:
    """What `--kind NAME FLAGS` told, in order; without any the two that ship."""
    return tuple((name, flags) for name, flags in given) or KINDS
