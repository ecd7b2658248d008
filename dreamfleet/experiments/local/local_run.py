"""A run served on this host: its flags checked, its coordinator and workers started, its end awaited.

Pages: platforms.md.
"""

from __future__ import annotations

import argparse
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from random import SystemRandom
from typing import Any

from dreamfleet.common.cli.command_line import build_parser
from dreamfleet.common.cli.global_config import GlobalConfig
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError, DreamfleetError, StoppedError, UsageError
from dreamfleet.common.files.regular_files import path_exists
from dreamfleet.common.host.processes import VerbProcess
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.host.stop_signals import Stop, signals_deferred
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_paths import JOURNAL
from dreamfleet.common.transport.network import LOOPBACK, Network, at_host, wait_for_listener
from dreamfleet.coordinator.settings import run_setup
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.experiments.local import command_lines
from dreamfleet.experiments.local.command_lines import Words

# Variables of a process that stays on this host, even if its user is in a fleet.
ALONE = {"DREAMFLEET_JOIN": "", "DREAMFLEET_CONNECT": ""}
CONNECT_INTERVAL = 0.05  # seconds between two attempts to reach a coordinator that listens and does not answer yet
POLL_INTERVAL = 0.2  # seconds between two looks whether to stop
START_SECONDS = 180.0  # a coordinator that ends earlier is seen at once; a busy host takes its time
PORTS = range(20_000, 32_000)
# Flags of `coordinator` that each run of an experiment has its own of, by the names of their values.
RESERVED = {"run_name": "--run", "source": "--from"} | {
    name: f"--{name.replace('_', '-')}"
    for name in ("resume", "init", "bundle", "seed", "runs_dir", "listen", "connect", "config", "subspace")
}


@dataclass(frozen=True)
class LocalFleet:
    """Where a run's coordinator listens, how many slots this host scores with, and further flags of both."""

    listen: tuple[str, ...]
    slots: int
    coordinator: tuple[str, ...] = ()  # flags of a run's first coordinator
    worker: tuple[str, ...] = ()
    security: tuple[str, ...] = ()  # flags of its first and of its resuming coordinators

    @classmethod
    def of(
        cls, listen: tuple[str, ...], local: int | None, coordinator: tuple[str, ...], worker: tuple[str, ...],
        join: Path | None = None, security: tuple[str, ...] = (), *, insecure: bool = False,
    ) -> LocalFleet:  # fmt: skip
        """Without `listen`: a free port of this host. Without `local`: a slot per core, or none where `listen` is.

        `security` are a coordinator's flags for the fleet of the join file.
        """
        joined = () if join is None else ("--join", str(join))
        security = (*security, *(("--insecure",) if insecure else ()))
        here = f"{'tcp' if join is None else 'tls'}/127.0.0.1:{free_port()}"
        slots = local if local is not None else 0 if listen else usable_cores()
        return cls(listen or (here,), slots, coordinator, (*worker, *joined), security)

    @property
    def local_endpoint(self) -> str:
        """Where this host's own workers connect to."""
        return at_host(self.listen[0], LOOPBACK)


class LocalRun:
    """A run's coordinator, and workers of this host, as child processes; leaving the context ends them."""

    def __init__(self, name: str, words: Words, logs: Path, environment: Mapping[str, str] | None = None) -> None:
        """`words` are the coordinator's command line; each process logs into a file in `logs`."""
        self._name, self._words, self._logs, self._environment = name, words, logs, environment
        self._workers: list[VerbProcess] = []

    def __enter__(self) -> LocalRun:
        self._stack = ExitStack()
        self.coordinator = self._start(self._words, "coordinator")
        return self

    def __exit__(self, *_error: object) -> None:
        with signals_deferred():  # a second Ctrl-C would leave processes behind
            for each in self._workers:  # together: each may be in an episode
                each.ask_to_end()
            self._stack.close()

    def connect(self, endpoint: str) -> Client:
        """A client of the coordinator, once that answers at `endpoint`.

        `DreamfleetError` if it ends before, `UsageError` if its command line was wrong.
        """

        def check() -> None:
            if (code := self.coordinator.exit_code) is not None:
                raise (UsageError if code == UsageError.exit_code else DreamfleetError)(self.coordinator.last_line())

        return connect_once_ready(Network(connect=(endpoint,)), check, lambda client: client.document(self._name))

    def start_worker(self, name: str, words: Sequence[str]) -> None:
        """Start a worker by its command line; it logs into `name`.log."""
        self._workers.append(self._start(words, name))

    def end_workers(self) -> None:
        """End the workers at once, which have nothing to finish."""
        with signals_deferred():
            while self._workers:
                self._workers.pop().end(0)

    def _start(self, words: Sequence[str], name: str) -> VerbProcess:
        log, environment = self._logs / f"{name}.log", self._environment
        with signals_deferred():  # what is started is also ended
            process = VerbProcess(*words, log=log, environment=environment, ends_with_parent=True)
            return self._stack.enter_context(process)

    def check_workers(self) -> None:
        """`DreamfleetError` if every worker failed: the coordinator would wait for ever."""
        if self._workers and all(each.exit_code not in (None, 0) for each in self._workers):
            raise DreamfleetError(f"this host's workers failed: {self._workers[-1].last_line()}")

    def wait(self, stop: Stop, on_poll: Callable[[], None], interval: float = POLL_INTERVAL) -> None:
        """Wait until the coordinator ends, calling `on_poll` meanwhile.

        `StoppedError` if `stop` is true or the run was left open, `DreamfleetError` if the coordinator failed.
        """
        while not self.coordinator.wait(0):
            if stop():
                raise StoppedError("stopped")
            on_poll()
            self.coordinator.wait(interval)
        self.check_end()

    def check_end(self) -> None:
        """Errors as in `wait`, of a coordinator that has ended."""
        code, _ = self.coordinator.finish()
        if code == StoppedError.exit_code:
            raise StoppedError(f"run {self._name} was left open")
        if code != 0:
            log = self._logs / "coordinator.log"
            raise DreamfleetError(f"{self.coordinator.last_line()}; the coordinator's log is {log}")


def connect_once_ready(
    network: Network, check: Callable[[], None], probe: Callable[[Client], object] = lambda _client: None
) -> Client:
    """A client as soon as one is accepted and `probe(client)` is answered; `check` is called before each try."""
    deadline = time.monotonic() + START_SECONDS
    while True:
        check()
        wait_for_listener(network.connect, POLL_INTERVAL, lambda: False)
        try:
            with ExitStack() as stack:
                client = stack.enter_context(Client(network))
                probe(client)
                stack.pop_all()
                return client
        except ConnectionFailedError:
            if time.monotonic() > deadline:
                raise
            time.sleep(CONNECT_INTERVAL)


def coordinator_words(name: str, runs_dir: Path, fleet: LocalFleet, begin: Callable[[], Words]) -> Words:
    """The coordinator's command line: it resumes a run that has begun, and begins another with the flags of `begin`."""
    if has_begun(runs_dir, name):
        return command_lines.resume_run(name, runs_dir, fleet.listen, *fleet.security)
    return command_lines.begin_run(name, runs_dir, fleet.listen, *fleet.coordinator, *fleet.security, *begin())


def evolve(name: str, words: Words, fleet: LocalFleet, logs: Path, stop: Stop) -> None:
    """Serve a run until it ends, as `LocalRun.wait` does; also `DreamfleetError` if this host's worker failed."""
    with LocalRun(name, words, logs) as run:
        if fleet.slots:
            flags = ("--exit-when-done", *fleet.worker)
            run.start_worker("worker", command_lines.worker(name, fleet.local_endpoint, fleet.slots, *flags))
        run.wait(stop, run.check_workers)


def task_flags(*tasks: str) -> tuple[str, ...]:
    """The flags by which a worker announces those of these tasks that it does not announce by itself.

    >>> task_flags("dream", "gym:mine:Own-v0")
    ('--task', 'gym:mine:Own-v0')
    """
    return tuple(word for task in dict.fromkeys(tasks) if ":" in task for word in ("--task", task))


def security_flags(args: argparse.Namespace) -> tuple[str, ...]:
    """The flags by which another coordinator has the same join file and list of revoked files; none without one."""
    join, access_dir = args.global_config.join, args.global_config.access_dir
    if join is None:
        return ()
    return ("--join", str(join), *(("--access-dir", str(access_dir)) if access_dir != GlobalConfig.access_dir else ()))


def has_begun(runs_dir: Path, name: str) -> bool:
    """Whether the run has a journal."""
    return path_exists(runs_dir / name / JOURNAL)


def has_ended(runs_dir: Path, name: str) -> bool:
    """Whether the run has begun and reached its end."""
    if not has_begun(runs_dir, name):
        return False
    with open_run(runs_dir, name) as run:
        return run.ended is not None


def parse_run_flags(flags: Sequence[str], sources: Mapping[str, Any], verb: str) -> tuple[RunConfig, LimitsConfig]:
    """What a run is and when it ends, by its flags, the environment and the file.

    `sources` are those of `verb`, as `complete_arguments` left them. `UsageError` for flags that `verb` sets itself,
    for wrong ones, and where none sets a limit.
    """
    try:
        parsed = build_parser("coordinator", run_setup).parse_all(list(flags))
    except UsageError as error:
        raise UsageError(f"--run-flags: {error}") from error
    if taken := [flag for name, flag in RESERVED.items() if getattr(parsed, name, None) is not None]:
        raise UsageError(f"{', '.join(taken)} in --run-flags: {verb} sets them for each run; give --config to {verb}")
    return load_parsed_flags(parsed, sources)


def load_parsed_flags(parsed: argparse.Namespace, sources: Mapping[str, Any]) -> tuple[RunConfig, LimitsConfig]:
    """What a run is and when it ends, by parsed flags of `coordinator` and the `sources` of another verb.

    `UsageError` where none sets a limit.
    """
    args = argparse.Namespace(sources={**sources, "flags": parsed}, given=frozenset(vars(parsed)))
    config, limits = run_setup.load_run_config(args, base={})
    if limits == LimitsConfig():
        raise UsageError("a run would never end: give its flags a limit, such as --generations 32")
    return config, limits


def free_port() -> int:
    """A port that is free, below those that connections get: one of them could take it before the coordinator does."""
    for port in SystemRandom().sample(PORTS, 100):
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise DreamfleetError("no port of this host is free: name one with listen")
