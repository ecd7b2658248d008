"""What a coordinator logs about its run while it serves it. Pages: monitor.md, fleet.md, own-environment.md."""

import logging
import math
import shlex
import socket
from collections.abc import Iterable
from dataclasses import asdict
from itertools import islice
from time import monotonic, time
from typing import Any

from dreamfleet.common.client.equal_fitness import EqualFitness
from dreamfleet.common.client.run_view import LiveRunView
from dreamfleet.common.client.status import Status
from dreamfleet.common.host.logs import log_event
from dreamfleet.common.host.reports import ADDRESS, report
from dreamfleet.common.printable import format_number, plural
from dreamfleet.common.protocol.tasks import is_function_task, is_unregistered
from dreamfleet.common.runs.records import StoredGeneration, count_episodes, format_mean, in_values, with_error
from dreamfleet.common.security.credentials import EXPIRY_WARNING, Credentials, describe_time_left
from dreamfleet.common.transport.network import Network, at_host, is_loopback
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.run.shown_state import WAITS_FOR_WORKERS, shown_state
from dreamfleet.coordinator.service.snapshot import Snapshot

log = logging.getLogger(__name__)
SUMMARY_INTERVAL = 60.0  # seconds from one summary line to the next
DAY = 86_400.0  # seconds from one warning that the join file expires to the next
CLOCK_STEP = 5.0  # seconds by which a wall clock that is not set stays true
NO_WORKER_SECONDS = 5.0  # seconds without a worker before the log says so


class RunLog:
    """Logs a run's begin, generations, evaluations and notes, a summary every minute, and what needs attention."""

    def __init__(self, run: Run, name: str, network: Network, now: float) -> None:
        self._run = run
        self._name = name
        self._network = network
        self._evaluations_logged = len(run.background_jobs.evaluations)
        self._summary_at = now
        self._no_worker_since = now
        self._expiry_at = 0.0
        self._clock_offset = time() - monotonic()
        self._equal = EqualFitness(run.history.rows)

    def begin(self) -> None:
        """The run is served from now on."""
        run, listen = self._run, self._network.listen
        text = f"incarnation {run.incarnation} begins with generation {run.generation.number}"
        log_event(log, "begin", text, run=self._name, run_uid=run.uid, incarnation=run.incarnation)
        if run.settings.confirm_episodes and not is_function_task(run.settings.task.task):
            episodes = plural(run.settings.confirm_episodes, "whole episode")
            log.info(
                "once its last generation is closed, %s or more confirm the best mean (--confirm-episodes)", episodes
            )
        report(ADDRESS, listen or self._network.connect)
        if listen:
            log.info("listening on %s", ", ".join(listen))
            if self._network.credentials is None and not all(is_loopback(each) for each in listen):
                text = "this is neither encrypted nor authenticated: anyone who reaches the port controls the run"
                log_event(log, "insecure", f"{text} (docs/how-to/security.md)", level=logging.WARNING)

    def report_closed(self, generations: Iterable[StoredGeneration]) -> None:
        """Log these closed generations, and the evaluations that have finished since the last call."""
        task = self._run.settings.task
        for closed in generations:
            self._warn_of_equal_fitness(closed)
            failed = f", {closed.failed} failed" if closed.failed else ""
            shown = in_values(closed, task)
            scores = f"average {format_number(shown.mean)}, best {format_number(shown.best)}"
            log_event(log, "generation", f"generation {closed.number}: {scores}{failed}", **asdict(closed))
        evaluations = self._run.background_jobs.evaluations
        if len(evaluations) > self._evaluations_logged:
            for each in islice(evaluations.finished.values(), self._evaluations_logged, None):  # as they finished
                mean = format_mean(in_values(each, task)) + ("" if each.error is None else " (standard error)")
                text = f"evaluation of generation {each.generation}'s mean: {mean} over {count_episodes(each)}"
                log_event(log, "evaluation", text, **with_error(each))
            self._evaluations_logged = len(evaluations)

    def _warn_of_equal_fitness(self, closed: StoredGeneration) -> None:
        """Warn of generations whose candidates all have one fitness; again only after as many others in a row."""
        equal = self._equal
        equal.add(closed)
        if equal.is_due and not self._run.settings.is_external:
            text = equal.describe(self._run.settings.task)
            log_event(log, "equal fitness", text, level=logging.WARNING, generation=closed.number)

    def write_notes(self) -> None:
        """Log the run's notes since the last call."""
        for note in self._run.take_notes():
            log_event(log, note.what, note.text, worker=note.worker)

    def check(self, snapshot: Snapshot, now: float) -> None:
        """Log what is due: a warning that no worker is present, the minute's summary, the join file's expiry."""
        self._warn_if_no_worker(now)
        self._note_clock()
        if now - self._summary_at >= SUMMARY_INTERVAL:
            self._summary_at = now
            text, facts = summary(snapshot.full_status())
            log_event(log, "summary", text, **facts)
            if self._network.credentials is not None and now >= self._expiry_at:
                self._expiry_at = now + DAY
                _warn_of_expiry(self._network.credentials)

    def _note_clock(self) -> None:
        """Note that the wall clock moved against the monotonic one, by which all deadlines are kept."""
        offset = time() - monotonic()  # `now` may be older: a commit waits for a locked journal
        if abs(moved := offset - self._clock_offset) > CLOCK_STEP:
            self._run.fleet.note(f"the wall clock moved by {moved:+,.0f} s: it was set, or this host slept", "clock")
            self._clock_offset = offset

    def _warn_if_no_worker(self, now: float) -> None:
        """Warn once per spell without workers: a run that stands still should not be silent."""
        if shown_state(self._run).word != WAITS_FOR_WORKERS:
            self._no_worker_since = now
        elif now - self._no_worker_since > NO_WORKER_SECONDS:
            self._no_worker_since = math.inf
            command = worker_command(self._network, self._name, self._run.settings.task.task)
            text = f"no worker is present: the run waits for one; on any host: {command}"
            log_event(log, "no worker", text, level=logging.WARNING, command=command)


def _warn_of_expiry(credentials: Credentials) -> None:
    """Warn in the join file's last week: links break when a certificate expires."""
    if (left := credentials.time_left) < EXPIRY_WARNING:
        text = f"this coordinator's join file: {describe_time_left(left)}; issue another and start it again with that"
        log_event(log, "expiry", text, level=logging.WARNING, seconds=left.total_seconds())


def summary(status: Status) -> tuple[str, dict[str, Any]]:
    """The status in one line, and as facts."""
    best, view = status.confirmed or status.best, LiveRunView.of_status(status)
    facts = {
        "state": status.state, "generation": status.generation.number,
        "steps_per_second": status.throughput.steps_per_second, "best": None if best is None else best.mean,
        "best_error": None if best is None else best.error, "workers": status.workers.present, "slots": status.slots,
        "eta_seconds": view.eta.seconds, "failed": view.failed,
    }  # fmt: skip
    return view.summary, facts


def worker_command(network: Network, run: str, task: str) -> str:
    """The command that starts a worker of the run on any host; it names the `task` only if no package registers it.

    With join files the worker's own names the addresses.
    """
    addresses = [at_host(each, socket.gethostname()) for each in network.listen or network.connect]
    where = ("--connect", *addresses) if network.credentials is None else ("--join", "FILE")
    own = ("--task", task) if is_unregistered(task) else ()
    return shlex.join(("dreamfleet", "worker", "--run", run, *where, *own))
