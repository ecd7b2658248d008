"""Run an iteration phase by phase; each is in the ledger before the next begins."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from dreamfleet.common.cli.command_line import parse_flags
from dreamfleet.common.cli.model_commands import MODELS, Model, Words
from dreamfleet.common.errors import DreamfleetError, StoppedError, UsageError
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.host.stop_signals import Stop
from dreamfleet.experiments.iteration import artefacts
from dreamfleet.experiments.iteration.commands import Commands
from dreamfleet.experiments.iteration.config import IterateConfig
from dreamfleet.experiments.iteration.layout import IterationFolder
from dreamfleet.experiments.iteration.ledger import FinishedPhase, IterationLedger
from dreamfleet.experiments.iteration.phases import PhaseRunner
from dreamfleet.experiments.iteration.plan import Phase, PhasePlan
from dreamfleet.experiments.local_run import LocalFleet
from dreamfleet.experiments.verb_runner import ProcessRunner, find_verb

log = logging.getLogger("dreamfleet.coordinator.iterate")


class Iteration:
    """An iteration in a folder that the caller has locked."""

    def __init__(
        self,
        layout: IterationFolder,
        config: IterateConfig,
        ledger: IterationLedger,
        local_fleet: Callable[[], LocalFleet],
        stop: Stop,
        network_flags: Words = (),
    ) -> None:
        """`network_flags` are not in the ledger, so the printed resume command repeats them."""
        self.ledger = ledger
        self._resume_command = shell_command("iterate", "--data", layout.root, *network_flags)
        self._layout, self._config, self._local_fleet, self._stop = layout, config, local_fleet, stop
        self._runner = ProcessRunner(stop)
        self._plan = PhasePlan(config, bool(ledger.run.get("collect_every")))

    def redo(self, phase: Phase) -> None:
        """Undo a finished phase and all after it, and remove the files that they made."""
        phases = self._plan.phases_from(phase, self.ledger.finished)
        self.ledger = artefacts.undo(self._layout, self.ledger, phases)
        self.ledger.save(self._layout.ledger)

    def begin(self) -> None:
        """Check the flags of `bundle`, and the files of finished phases or a new iteration's training flags.

        With `init` the first phase checks the flags, because they must fit the model that is there. Those of another
        world than the first are checked once there are data of it, which presets must fit.
        """
        commands = Commands(self._config, self._layout, self.ledger)
        parse_flags(*find_verb(commands.bundle(1)))
        artefacts.check(self._layout, self.ledger)
        if self.ledger.entries or self._config.init or self._config.task:
            return
        for model in MODELS:
            if getattr(self._config, f"{model}_flags"):
                self._check_flags(commands.check_training(model), model)

    def run_remaining(
        self,
        on_begin: Callable[[Phase], None],
        on_finished: Callable[[FinishedPhase], None],
        on_line: Callable[[str], None],
    ) -> None:
        """Run what is left; `on_begin` is called as a phase begins, `on_finished` when it is in the ledger.

        `on_line` gets each progress line of a phase's verbs.
        """
        while (phase := self._plan.next(self.ledger.finished)) is not None:
            on_begin(phase)
            entry = self._run_phase(phase, on_line)
            self.ledger = self.ledger.add(entry)
            self.ledger.save(self._layout.ledger)
            on_finished(entry)

    def _run_phase(self, phase: Phase, on_line: Callable[[str], None]) -> FinishedPhase:
        commands, begun = Commands(self._config, self._layout, self.ledger), time.monotonic()
        with self._explain_errors(phase):
            done = PhaseRunner(commands, self._local_fleet, partial(self._ask, on_line), self._stop).do(phase)
            made = artefacts.hash_artefacts(self._layout, done.made)
        seconds, at = round(time.monotonic() - begun, 1), datetime.now(UTC).isoformat(timespec="seconds")
        seed = commands.seed(phase)
        return FinishedPhase(phase.round, phase.name, seed, seconds, at, done.commands, done.figures or {}, made)

    @contextmanager
    def _explain_errors(self, phase: Phase) -> Iterator[None]:
        """Add the phase to an error, and to a stop the command that resumes."""
        try:
            yield
        except StoppedError as error:
            raise StoppedError(
                f"{phase}: {error}; what is finished is kept; resume with: {self._resume_command}"
            ) from error
        except DreamfleetError as error:
            raise type(error)(f"{phase}: {error}") from error

    def _ask(self, on_line: Callable[[str], None], words: Words, path: Path) -> Any:
        log.debug("dreamfleet %s", " ".join(words))
        return self._runner.run_for_json(words, path, on_line)

    def _check_flags(self, words: Words, model: Model) -> None:
        try:
            self._runner.run(words, self._layout.root / "logs" / f"{model}.log")
        except UsageError as error:
            raise UsageError(f"--{model}-flags: {error}") from error
