"""Serve a sweep: a router, the coordinators of a few runs at a time, and workers that serve all of them."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import DreamfleetError, StoppedError
from dreamfleet.common.host.child import END_TIMEOUT
from dreamfleet.common.host.processes import VerbProcess, shell_command
from dreamfleet.common.host.stop_signals import Stop, signals_deferred
from dreamfleet.common.protocol.function_values import value_of
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.stop_kind import PauseKind
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.schema.validation import from_plain_lenient
from dreamfleet.common.transport.network import LOOPBACK, Network, at_host
from dreamfleet.coordinator.addons.environment_check import CHECKED
from dreamfleet.coordinator.run.shown_state import WAITS_FOR_WORKERS
from dreamfleet.experiments.local import local_run
from dreamfleet.experiments.local.command_lines import Words, command
from dreamfleet.experiments.local.local_run import POLL_INTERVAL, has_begun, has_ended, task_flags
from dreamfleet.experiments.sweep.folder import StoredSweep, SweepFolder
from dreamfleet.experiments.sweep.plan import SweepRun, staggered_share

STATUS_INTERVAL = 2.0  # seconds between two looks at all runs
RESTART_PAUSE = 5.0  # seconds of life after which a worker or router that was killed is started again
PAUSE_TIMEOUT = 30.0  # seconds for which a run may pause by itself: a full disk or a host may get better
FULL_DISK = 1 << 20  # bytes that are left of a disk on which a coordinator cannot even say so
MOST_RESTARTS = 3  # of a run's coordinator that was killed


@dataclass(frozen=True)
class SweepFleet:
    """Where the runs of a sweep meet their workers, and how many of each are on this host.

    A router of the sweep's own listens at `network`; with `has_router` false, `network` reaches one that others run.
    """

    network: Network
    workers: int
    parallel: int
    has_router: bool = True
    security: Words = ()  # flags of the coordinators

    @property
    def endpoint(self) -> str:
        """Where workers of other hosts connect to."""
        return (self.network.listen or self.network.connect)[0]

    @property
    def local_endpoint(self) -> str:
        """Where this host's own processes connect to."""
        return at_host(self.endpoint, LOOPBACK)


@dataclass
class RunProgress:
    """How far one run of the sweep is."""

    run: SweepRun
    state: str = "waiting"  # running, finished, failed, left open
    text: str = ""
    restarts: int = 0
    paused_since: float | None = None  # while it is paused, and not by hand, or only barred workers are here

    @property
    def is_over(self) -> bool:
        """Whether the sweep does nothing more for it."""
        return self.state in ("finished", "failed", "left open")


class SweepRunner:
    """Serves all runs of a sweep to their ends; leaving the context ends its processes."""

    def __init__(self, stored: StoredSweep, folder: SweepFolder, fleet: SweepFleet, config: Path | None) -> None:
        self._sweep, self._tasks, self._folder, self._fleet = stored.sweep, stored.tasks, folder, fleet
        self.progress = [RunProgress(each) for each in self._sweep.runs]
        self._config = () if config is None else ("--config", str(config))
        self._coordinators: dict[str, VerbProcess] = {}
        self._helpers: dict[str, tuple[Words, VerbProcess, float]] = {}  # router and workers, with when they started
        self._looked_at = 0.0
        self._uids: dict[str, str] = {}

    def __enter__(self) -> SweepRunner:
        with ExitStack() as stack:
            # Fresh, as a task may have changed, and this user's alone.
            self._checks = stack.enter_context(tempfile.TemporaryDirectory(prefix="dreamfleet-checks-"))
            stack.callback(self._end)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_error: object) -> None:
        with signals_deferred():  # a second Ctrl-C would leave processes behind
            self._stack.close()

    def serve(self, stop: Stop, on_change: Callable[[], None]) -> None:
        """Serve until every run is over; `StoppedError` as soon as `stop` is true."""
        self._start_fleet()
        network = replace(self._fleet.network, listen=(), connect=(self._fleet.local_endpoint,))
        with local_run.connect_once_ready(network, self._check_helpers) as client:
            while not all(each.is_over for each in self.progress):
                if stop():
                    raise StoppedError("stopped")
                self._start_coordinators()
                self._check_coordinators()
                self._check_helpers()
                self._look(client)
                on_change()
                time.sleep(POLL_INTERVAL)

    def _start_fleet(self) -> None:
        if self._fleet.has_router:
            insecure = ("--insecure",) if "--insecure" in self._fleet.security else ()
            self._start_helper("router", command("router", "--listen", self._fleet.endpoint, *insecure))
        for number in range(self._fleet.workers):
            name = f"core-{number}"
            flags = ("--any", "--runs", self._fleet.parallel, "--slots", 1, "--name", name, *task_flags(*self._tasks))
            self._start_helper(name, command("worker", "--connect", self._fleet.local_endpoint, *flags))

    def _start_coordinators(self) -> None:
        """Start or resume runs until `parallel` are open; a run that has ended before is finished."""
        for each in self.progress:
            if len(self._coordinators) >= self._fleet.parallel:
                return
            if each.state == "waiting":
                name, runs_dir = each.run.name, self._folder.runs_dir
                if has_ended(runs_dir, name):
                    each.state, each.text = "finished", "before"
                    continue
                each.state, each.text = "running", ""
                self._coordinators[name] = self._start(self._run_command(each.run), runs_dir / name / "coordinator.log")

    def _run_command(self, run: SweepRun) -> Words:
        own: tuple[object, ...] = ("--resume", run.name)
        if not has_begun(self._folder.runs_dir, run.name):
            share = staggered_share(self._sweep.runs.index(run), self._fleet.parallel)
            own = ("--run", run.name, "--share", share, *self._sweep.flags, *run.flags)
        place = ("--runs-dir", self._folder.runs_dir, "--connect", self._fleet.local_endpoint, "--json")
        return command("coordinator", *own, *self._fleet.security, *self._config, *place)

    def _check_coordinators(self) -> None:
        """Note which runs are over. A coordinator that was killed is started again."""
        for each in self.progress:
            process = self._coordinators.get(each.run.name)
            if process is None or (code := process.exit_code) is None:
                continue
            del self._coordinators[each.run.name]
            process.end()
            if each.is_over:  # it was ended from here
                continue
            if code == 0:
                each.state, each.text = "finished", ""
            elif code == StoppedError.exit_code:
                each.state, each.text = "left open", "it was stopped or drained"
            elif code < 0 and each.restarts < MOST_RESTARTS:
                each.state, each.restarts = "waiting", each.restarts + 1
                each.text = "its coordinator was killed"
            else:  # its log is empty where the disk is full
                full = shutil.disk_usage(self._folder.runs_dir).free < FULL_DISK
                each.state = "failed"
                each.text = f"{'the disk of its folder is full; ' if full else ''}{process.last_line()}"

    def _look(self, client: Client) -> None:
        """Read how far the open runs are. One that stays paused by itself might wait for ever, so it has failed."""
        if time.monotonic() - self._looked_at < STATUS_INTERVAL:
            return
        statuses: list[dict[str, Any]] = []
        with suppress(DreamfleetError):  # the router is being started again
            statuses = client.statuses(STATUS_INTERVAL)
        self._looked_at = time.monotonic()
        found = {status.get("run_uid"): status for status in statuses}  # other runs may have equal names
        for each in self.progress:
            status = found.get(self._uid_of(each.run.name))
            if status is None or each.run.name not in self._coordinators:
                continue
            barred = self._describe_barred(each.run.name, status)
            each.text = barred or describe(status)
            if not barred and (status.get("state") != "paused" or status.get("pauses") == [PauseKind.BY_HAND]):
                each.paused_since = None  # decided as in `StartedRun._check_pause`
            elif each.paused_since is None:
                each.paused_since = self._looked_at
            elif self._looked_at - each.paused_since > PAUSE_TIMEOUT:
                each.state, each.text = "failed", barred or f"paused: {status.get('why')}"
                self._coordinators[each.run.name].ask_to_end()

    def _describe_barred(self, name: str, status: Mapping[str, Any]) -> str:
        """That a run waits, since all of this host's workers are barred from it, and what to do; empty: it does not."""
        checks = status.get("checks") or {}
        workers = {each for each in self._helpers if each != "router"}
        if status.get("state") != WAITS_FOR_WORKERS or not workers or not workers <= {*checks.get("barred", ())}:
            return ""
        again = shell_command("bar", min(workers), name, "--no-longer", "--runs-dir", self._folder.runs_dir)
        return (
            f"it waits for workers, and this host's are barred from it; one that scores rightly may join again: {again}"
        )

    def _uid_of(self, name: str) -> str | None:
        """A run's own name for ever; `None` before it has begun."""
        if name not in self._uids:
            with suppress(DreamfleetError):
                if has_begun(self._folder.runs_dir, name):
                    with open_run(self._folder.runs_dir, name) as run:
                        self._uids[name] = run.uid
        return self._uids.get(name)

    def _check_helpers(self) -> None:
        """Start a router or worker again that was killed; `DreamfleetError` if one fails."""
        for name, (words, process, started) in list(self._helpers.items()):
            if (code := process.exit_code) is None:
                continue
            if code >= 0 and name == "router":
                raise DreamfleetError(f"the sweep's router failed: {process.last_line()}")
            if code >= 0 and not any(each.exit_code is None for each in self._workers):
                raise DreamfleetError(f"this host's workers failed: {process.last_line()}")
            if code < 0 and time.monotonic() - started > RESTART_PAUSE:
                process.end()
                self._start_helper(name, words)

    @property
    def _workers(self) -> list[VerbProcess]:
        return [process for name, (_, process, _) in self._helpers.items() if name != "router"]

    def _start_helper(self, name: str, words: Words) -> None:
        self._helpers[name] = words, self._start(words, self._folder.path / f"{name}.log"), time.monotonic()

    def _start(self, words: Words, log: Path) -> VerbProcess:
        alone = local_run.ALONE if self._fleet.has_router else {}  # a fleet of the user's has its own
        environment = {**os.environ, **alone, CHECKED: self._checks}
        return VerbProcess(*words, log=log, environment=environment, ends_with_parent=True)

    def _end(self) -> None:
        """End the workers, then the coordinators, which leave their runs open, then the router."""
        routers = [process for name, (_, process, _) in self._helpers.items() if name == "router"]
        for together in (self._workers, list(self._coordinators.values()), routers):
            for each in together:
                each.ask_to_end()
            deadline = time.monotonic() + END_TIMEOUT
            for each in together:
                each.wait(deadline - time.monotonic())
            for each in together:
                each.end()


def describe(status: Mapping[str, Any]) -> str:
    """A run's progress in a few words; empty for a status of another version."""
    with suppress(DreamfleetError, KeyError, TypeError, ValueError):
        closed, limit = int(status["generations"]), int(status["limits"].get("generations") or 0)
        state = "" if status["state"] == "running" else f"{status['state']}, "
        task = from_plain_lenient(TaskSpec, status["settings"]["task"])
        judged = status.get("confirmed") or status.get("best")
        score = "" if judged is None else f", evaluated {value_of(float(judged['mean']), task):z.4g}"
        return f"{state}generation {closed}{f' of {limit}' if limit else ''}{score}"
    return ""
