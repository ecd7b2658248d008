"""Run an iteration phase by phase; each is in the ledger before the next begins."""

import time
from collections.abc import Callable
from datetime import UTC, datetime

from dreamfleet.common.errors import DreamfleetError, StoppedError, UsageError
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.host.stop_signals import Stop
from dreamfleet.experiments.iteration import artefacts
from dreamfleet.experiments.iteration.config import IterateConfig
from dreamfleet.experiments.iteration.layout import IterationFolder
from dreamfleet.experiments.iteration.ledger import FinishedPhase, IterationLedger, as_data
from dreamfleet.experiments.iteration.phases import PhaseRunner
from dreamfleet.experiments.iteration.plan import Phase, PhasePlan
from dreamfleet.experiments.iteration.requests import Requests
from dreamfleet.experiments.local.command_lines import Words
from dreamfleet.experiments.local.isolated import run_isolated
from dreamfleet.experiments.local.local_run import LocalFleet
from dreamfleet.worker.training.stages.train import MODELS, summarise


class Iteration:
    """An iteration in a folder that the caller has locked."""

    def __init__(
        self, layout: IterationFolder, config: IterateConfig, ledger: IterationLedger,
        local_fleet: Callable[[], LocalFleet], stop: Stop, network_flags: Words = (),
    ) -> None:  # fmt: skip
        """`network_flags` are not in the ledger, so the printed resume command repeats them."""
        self.ledger = ledger
        self._resume_command = shell_command("iterate", "--data", layout.root, *network_flags)
        self._layout, self._config, self._local_fleet, self._stop = layout, config, local_fleet, stop
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
        requests = Requests(self._config, self._layout, self.ledger)
        requests.bundle(1)  # reads them
        artefacts.check(self._layout, self.ledger)
        if self.ledger.entries or self._config.init or self._config.task:
            return
        for model in MODELS:
            if getattr(self._config, f"{model}_flags"):  # which must fit layers, though nothing is trained
                log = self._layout.root / "logs" / f"{model}.log"
                try:
                    run_isolated(summarise, requests.train(1, model), log, self._stop)
                except UsageError as error:
                    raise UsageError(f"--{model}-flags: {error}") from error

    def run_remaining(
        self, on_begin: Callable[[Phase], None], on_finished: Callable[[FinishedPhase], None],
        on_line: Callable[[str], None],
    ) -> None:  # fmt: skip
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
        requests, begun = Requests(self._config, self._layout, self.ledger), time.monotonic()
        try:
            done = PhaseRunner(requests, self._local_fleet, self._stop, on_line).do(phase)
            made = artefacts.hash_artefacts(self._layout, done.made)
        except StoppedError as error:
            kept = f"what is finished is kept; resume with: {self._resume_command}"
            raise StoppedError(f"{phase}: {error}; {kept}") from error
        except DreamfleetError as error:
            raise type(error)(f"{phase}: {error}") from error
        seconds, at = round(time.monotonic() - begun, 1), datetime.now(UTC).isoformat(timespec="seconds")
        asked, seed = tuple(map(as_data, done.requests)), requests.seed(phase)
        return FinishedPhase(phase.round, phase.name, seed, seconds, at, asked, done.figures or {}, made)
