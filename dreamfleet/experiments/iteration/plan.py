"""What an iteration does, in order: a round's phases, and which is next."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from dreamfleet.common.errors import UsageError
from dreamfleet.experiments.iteration.config import IterateConfig

INIT = "init"  # of round 0: copies --init
COLLECT, TAKE, DRIVE = "collect", "take", "drive"  # random drives, the last run's kept ones, its means' own
VAE: Final = "vae"
MDNRNN: Final = "mdnrnn"
ENCODE, BUNDLE, GATE, EVOLVE = "encode", "bundle", "gate", "evolve"
DATA = (COLLECT, TAKE, DRIVE)
ALL = (*DATA, VAE, ENCODE, MDNRNN, BUNDLE, GATE, EVOLVE)


class Phase(NamedTuple):
    """A part of a round that is finished or not; rounds count from 1, and round 0 is `--init`."""

    round: int
    name: str

    def __str__(self) -> str:
        return f"{self.round}/{self.name}"

    @classmethod
    def of(cls, text: str) -> Phase:
        """Parse ROUND/PHASE; `UsageError` if it is no phase."""
        number, _, name = text.partition("/")
        known = (INIT,) if number == "0" else ALL
        if not (number.isascii() and number.isdigit() and len(number) < 10 and name in known):
            raise UsageError(f"{text!r} is not a phase: write ROUND/PHASE; phases are {', '.join(ALL)}, and 0/init")
        return cls(int(number), name)


@dataclass(frozen=True)
class PhasePlan:
    """The phases of all rounds; `collects`: whether the rounds' runs keep rollouts."""

    config: IterateConfig
    collects: bool = False

    def phases(self, number: int) -> tuple[Phase, ...]:
        """The phases of one round, in order."""
        config, anew = self.config, self.config.is_from_scratch(number)
        left_out = {
            COLLECT: not (number == 1 or config.more_drives),
            TAKE: number == 1 or not self.collects,
            DRIVE: anew or not config.own_drives,
            GATE: anew or not (config.gate_drives or config.gate_losses or config.survival_episodes),
        }
        return tuple(Phase(number, name) for name in ALL if not left_out.get(name))

    def __iter__(self) -> Iterator[Phase]:
        if self.config.init:
            yield Phase(0, INIT)
        for number in range(1, self.config.rounds + 1):
            yield from self.phases(number)

    def next(self, finished: Sequence[Any]) -> Phase | None:
        """The first unfinished phase; None if all are finished."""
        done = set(finished)
        # The model of a round that has evolved without its gate counts.
        passed = {Phase(each.round, GATE) for each in finished if each.name == EVOLVE}
        return next((each for each in self if each not in done | passed), None)

    def phases_from(self, phase: Phase, finished: Sequence[Phase]) -> tuple[Phase, ...]:
        """A finished phase and all later ones that were finished or begun; `UsageError` if it is not finished."""
        if phase not in finished:
            known = ", ".join(map(str, finished)) or "none"
            raise UsageError(f"{phase} is not finished, so it cannot be done again; finished are {known}")
        behind = tuple(finished[finished.index(phase) :])
        begun = self.next(finished)
        return (*behind, begun) if begun else behind
