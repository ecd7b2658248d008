"""An iteration from phase to phase: each is in the ledger before the next begins."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from dreamfleet.common.errors import DreamfleetError, StoppedError, UsageError
from dreamfleet.common.processes import spoken
from dreamfleet.common.stopping import Stop
from dreamfleet.coordinator.iteration import artefacts
from dreamfleet.coordinator.iteration.commands import Commands, Words
from dreamfleet.coordinator.iteration.config import IterateConfig
from dreamfleet.coordinator.iteration.evolving import Crew
from dreamfleet.coordinator.iteration.layout import Layout
from dreamfleet.coordinator.iteration.ledger import Entry, Ledger
from dreamfleet.coordinator.iteration.phases import Phases
from dreamfleet.coordinator.iteration.plan import Phase, Plan
from dreamfleet.coordinator.iteration.process import ask, run

log = logging.getLogger("dreamfleet.coordinator.iterate")


class Iteration:
    """One life of it, in a folder that is held."""

    def __init__(
        self, layout: Layout, config: IterateConfig, ledger: Ledger, crew: Callable[[], Crew], stop: Stop,
        reached: Words = (),
    ) -> None:  # fmt: skip
        """`reached` are the flags of its command that no ledger keeps: where workers come to, and how."""
        self.ledger = ledger
        self._again = spoken("iterate", "--data", layout.root, *reached)
        self._layout, self._config, self._crew, self._stop = layout, config, crew, stop
        self._plan = Plan(config, bool(ledger.run.get("collect_every")))

    def redo(self, phase: Phase) -> None:
        """Forget a finished phase and all behind it, and remove what they made."""
        phases = self._plan.since(phase, self.ledger.finished)
        self.ledger = artefacts.undo(self._layout, self.ledger, phases)
        self.ledger.save(self._layout.ledger)

    def begin(self) -> None:
        """Look whether what is finished is still there; of a new one, whether training takes its flags.

        With `init` its first phase looks, for then they must fit a model that is there.
        """
        artefacts.check(self._layout, self.ledger)
        if self.ledger.entries or self._config.init:
            return
        commands = Commands(self._config, self._layout, self.ledger)
        for model in ("vae", "mdnrnn"):
            if getattr(self._config, f"{model}_flags"):
                self._try(commands.tried(model), model)

    def go_on(
        self, before: Callable[[Phase], None], after: Callable[[Entry], None], hear: Callable[[str], None]
    ) -> None:
        """Do what is left; `before` hears of each phase as it begins, `after` when it is in the ledger.

        `hear` is told each line of what a phase's verbs say of how far they are.
        """
        while (phase := self._plan.next(self.ledger.finished)) is not None:
            before(phase)
            entry = self._do(phase, hear)
            self.ledger = self.ledger.add(entry)
            self.ledger.save(self._layout.ledger)
            after(entry)

    def _do(self, phase: Phase, hear: Callable[[str], None]) -> Entry:
        commands, begun = Commands(self._config, self._layout, self.ledger), time.monotonic()
        with self._told(phase):
            done = Phases(commands, self._crew, partial(self._ask, hear), self._stop).do(phase)
            made = artefacts.made(self._layout, done.made)
        seconds, at = round(time.monotonic() - begun, 1), datetime.now(UTC).isoformat(timespec="seconds")
        seed = commands.seed(phase)
        return Entry(phase.round, phase.name, seed, seconds, at, done.commands, done.figures or {}, made)

    @contextmanager
    def _told(self, phase: Phase) -> Iterator[None]:
        """Say of which phase an error is, and of a stop how it goes on."""
        try:
            yield
        except StoppedError as error:
            raise StoppedError(
                f"{phase}: {error}; what is finished is kept, and goes on with: {self._again}"
            ) from error
        except DreamfleetError as error:
            raise type(error)(f"{phase}: {error}") from error

    def _ask(self, hear: Callable[[str], None], words: Words, path: Path) -> Any:
        log.debug("dreamfleet %s", " ".join(words))
        return ask(words, path, self._stop, hear)

    def _try(self, words: Words, model: str) -> None:
        try:
            run(words, self._layout.root / "logs" / f"{model}.log", self._stop)
        except UsageError as error:
            raise UsageError(f"--{model}-flags: {error}") from error
