"""Serve a run from a request: its folder, lock and journal, then the service. Pages: back-up.md, security.md."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.cli.global_config import GlobalConfig
from dreamfleet.common.errors import JournalError, UsageError
from dreamfleet.common.files.atomic_write import reporting_unwritable_folder
from dreamfleet.common.files.file_system import file_system_type, is_network, lock_problem
from dreamfleet.common.host.add_ons import add_on, find_add_on
from dreamfleet.common.protocol.keys import check_run_name
from dreamfleet.common.protocol.messages import Intervals
from dreamfleet.common.runs.own_runs import remember_run
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.run_folder import EPISODE_LIMIT, open_run
from dreamfleet.common.runs.run_lock import run_lock
from dreamfleet.common.runs.run_paths import ARCHIVE, BUNDLE, resume_command
from dreamfleet.common.security.certificate_ledger import LEDGER_FILE, RevocationWatcher
from dreamfleet.common.security.credentials import Credentials
from dreamfleet.common.security.host_key import make_host_key
from dreamfleet.common.transport.session import Network
from dreamfleet.common.worlds.score_words import score_word
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.service.service import OpenRun, Service
from dreamfleet.coordinator.settings.config import DEFAULT_BUNDLE, RunConfig
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.settings.resume_settings import serving_facts
from dreamfleet.coordinator.settings.start import SUBSPACE_FACT, StartPoint
from dreamfleet.coordinator.storage.file_watch import FileWatch
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.coordinator.storage.kept_revocations import REVOKED, revoked_seats_in
from dreamfleet.coordinator.storage.served_bundle import ServedBundle

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunRequest:
    """The run to serve; without `config` it is a continued one."""

    name: str
    runs_dir: Path
    config: RunConfig | None
    limits: LimitsConfig
    network: NetworkConfig
    start: StartPoint | None = None  # of a new run; without one it begins with zero parameters
    credentials: Credentials | None = None
    join: Path | None = None  # the file of the credentials
    access_dir: Path = GlobalConfig.access_dir  # holds the list of revoked certificates
    trust: tuple[str, ...] = ()  # modules that must be trusted again when the run is resumed
    again: str = ""  # the command that continues it, of a verb that does more than resume it

    @property
    def folder(self) -> Path:
        """The run's folder."""
        return self.runs_dir / check_run_name(self.name)

    @property
    def with_absolute_paths(self) -> RunRequest:
        """The same request with absolute paths, which hold in any working directory."""
        join = None if self.join is None else self.join.absolute()
        access = self.access_dir.absolute() if self._has_access_dir else self.access_dir
        return replace(self, runs_dir=self.runs_dir.absolute(), join=join, access_dir=access)

    @property
    def is_access_dir_named(self) -> bool:
        """Whether the user chose the folder of the list of revoked certificates."""
        return self.access_dir != GlobalConfig.access_dir

    @property
    def _has_access_dir(self) -> bool:
        """Whether a command elsewhere must name that folder: it was chosen, or the default one holds the list."""
        return self.is_access_dir_named or (self.access_dir / LEDGER_FILE).exists()

    def resume_command(self, folder: Path | None = None) -> str:
        """The command that continues the run, also in a `folder` that it was moved to."""
        if self.again and (folder or self.folder).absolute() == self.folder.absolute():
            return self.again
        access_dir = self.access_dir if self._has_access_dir else None
        return resume_command(folder or self.folder, self.join, access_dir, self.trust)


class Stop:
    """Stops whichever incarnation of the coordinator serves the run now. Safe in a signal handler."""

    def __init__(self) -> None:
        self.is_requested = False
        self.stop_service: Callable[[], None] = lambda: None

    def __call__(self) -> None:
        """End the loop soon."""
        self.is_requested = True
        self.stop_service()


def serve_run(request: RunRequest, on_stoppable: Callable[[Callable[[], None]], None] = lambda _stop: None) -> Run:
    """Serve a new or continued run until it ends or is stopped; `on_stoppable` receives the function that stops it.

    After results were recalled, another incarnation goes on from the journal, as after a kill (R33).
    """
    stop = Stop()
    on_stoppable(stop)
    with ExitStack() as lock:
        kept = _Kept(lock)
        while True:
            run = _serve_incarnation(request, stop, kept)
            if not run.state.is_rewound or stop.is_requested:
                return run
            request = replace(request, config=None, start=None)


@dataclass
class _Kept:
    """What one incarnation leaves to the next: the lock of the run's folder, and which seats are revoked.

    Between two incarnations no other program may take the run, and the list of revoked seats may be missing.
    """

    lock: ExitStack
    is_locked: bool = False
    revocations: RevocationWatcher | None = None


def _serve_incarnation(request: RunRequest, stop: Stop, kept: _Kept) -> Run:
    """Serve one incarnation of a run."""
    folder = request.folder
    if request.config is not None:
        if request.name == ARCHIVE:
            raise UsageError(f"{ARCHIVE!r} is where archived runs lie: choose another name")
        Journal.check_absent(folder)  # before the task is tried, which may take minutes
    _check_file_system(folder)
    if log_to := request.network.log_to:
        add_on("check-sinks")(log_to)
    settings, bundle, limit = _resolve_settings(request, folder)
    if request.network.verify and settings.is_external:  # docs/how-to/trust.md
        raise UsageError(
            f"--verify: a run with --optimiser {settings.optimiser} hands its scores out as they come, so none can be "
            "taken back; leave it out"
        )
    with ExitStack() as stack:
        journal: Journal | None = None
        if request.config is None:
            journal = _open_journal(request, folder, settings, bundle, {}, stack, kept)
        revocations = kept.revocations = kept.revocations or _watch_revocations(request, journal)

        def open_run() -> OpenRun:
            """The run; a new one is created here, once its addresses and its name are its own."""
            nonlocal journal
            known = {EPISODE_LIMIT: str(limit)} if limit else {}
            journal = journal or _open_journal(request, folder, settings, bundle, known, stack, kept)
            served = stack.enter_context(closing(ServedBundle(folder / BUNDLE))) if bundle else None
            file_watch = FileWatch(journal, served, request.with_absolute_paths.resume_command)
            stack.enter_context(closing(file_watch))
            if log_to:
                stack.enter_context(add_on("live-log")(folder, log_to))
            host_key = make_host_key() if request.network.verify else b""
            run = Run(
                journal, settings, request.limits, request.network, monotonic(), host_key,
                is_secured=request.credentials is not None,
            )  # fmt: skip
            return OpenRun(run, file_watch, served)

        word = score_word(settings.task.task) if bundle is None else bundle.manifest.world.score_word
        own, intervals = request.network, Intervals(request.network.beat, request.network.beat)
        network = Network(own.listen, own.connect, request.credentials, revocations.revoked_seats)
        service = Service(request.name, network, intervals, own.metrics_port, revocations, word)
        stop.stop_service = service.stop
        if stop.is_requested:
            service.stop()
        try:
            run = service.serve(open_run)
            stop.is_requested = stop.is_requested or service.is_asked_to_stop
            return run
        except JournalError as error:
            was_refused = isinstance(error.__cause__, (OSError, sqlite3.OperationalError))
            if not was_refused or journal is None or not journal.is_whole:
                raise
            raise JournalError(f"{error}; continue it with: {request.resume_command()}") from error


def _check_file_system(folder: Path) -> None:
    """`JournalError` if the run's file system keeps no locks; a warning if other hosts may share it."""
    if problem := lock_problem(folder):
        raise JournalError(problem)
    if is_network(kind := file_system_type(folder)):
        log.warning("%s is on a network file system (%s): read this run's files on this host alone, or a `runs backup`",
                    folder, kind)  # fmt: skip


def _watch_revocations(request: RunRequest, journal: Journal | None) -> RevocationWatcher:
    """What is revoked now, or was when the run was last served; `AccessError` where that cannot be known."""
    credentials, start = request.credentials, request.start
    fact = journal.fact(REVOKED) if journal is not None else start.revoked if start is not None else None
    kept = () if credentials is None else revoked_seats_in(fact, credentials.authority)
    return RevocationWatcher(request.access_dir, credentials, kept, named=request.is_access_dir_named)


def _open_journal(
    request: RunRequest, folder: Path, settings: RunSettings, bundle: Bundle | None, known: Mapping[str, str],
    stack: ExitStack, kept: _Kept,
) -> Journal:  # fmt: skip
    """Lock the run's folder, and open its journal with its limits, network settings and, of a new run, its start point.

    They are durable before anything else can fail: a coordinator that is killed resumes with all its settings.
    `known` are more facts of a new run; `stack` closes the journal.
    """
    with reporting_unwritable_folder(request.runs_dir, "choose another --runs-dir", JournalError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not kept.is_locked:
        kept.lock.enter_context(run_lock(folder))
        kept.is_locked = True
    facts = serving_facts(request.limits, request.network)
    if request.config is not None:
        start = request.start.facts if request.start else {}
        subspace = {SUBSPACE_FACT: request.config.loaded_subspace.text} if request.config.loaded_subspace else {}
        own = {**facts, **start, **subspace, **known}
        journal = stack.enter_context(closing(Journal.create(folder, settings, bundle.path if bundle else None, own)))
        remember_run(journal.fact("uid") or "", settings.task.task, settings.task.options)
        return journal
    journal = stack.enter_context(closing(Journal.open_verified(folder)))
    for name, text in facts.items():
        journal.set_fact(name, text)
    journal.commit()
    return journal


def _resolve_settings(request: RunRequest, folder: Path) -> tuple[RunSettings, Bundle | None, int]:
    """The run's settings, its verified bundle if its task needs one, and a new run's `_episode_limit`."""
    if request.config is not None:
        return _resolve_new_settings(request.config, request.start, strict=request.network.strict)
    with open_run(request.runs_dir, request.name) as stored:
        settings = stored.settings
    if not settings.task.bundle:
        return settings, None, 0
    return settings, Bundle.open(folder / BUNDLE, settings.task.bundle), 0


def _resolve_new_settings(
    config: RunConfig, start: StartPoint | None, *, strict: bool
) -> tuple[RunSettings, Bundle | None, int]:
    if start is not None and config.needs_no_bundle == (not start.bundle):
        config = start.apply_to(config)
    bundle = None if config.needs_no_bundle else find_bundle(config.bundle or DEFAULT_BUNDLE)
    if check_environment := find_add_on("check-environment"):
        config = check_environment(config, bundle, strict=strict)
    settings = freeze(config, bundle)
    if start is not None:
        start.check(settings, bundle)
    return settings, bundle, _episode_limit(config, bundle)


def _episode_limit(config: RunConfig, bundle: Bundle | None) -> int:
    """Steps after which a scored episode's environment ends it; 0 if it has no limit, none is known, or it dreams."""
    if bundle is None:
        return config.description.steps if config.description else 0
    return bundle.manifest.world.horizon if config.task in (None, bundle.manifest.task) else 0
