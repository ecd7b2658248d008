"""Serve a run from a request: its folder, lock and journal, then the service."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.cli.global_config import GlobalConfig
from dreamfleet.common.errors import ConnectionFailedError, JournalError, UsageError
from dreamfleet.common.files.atomic_write import reporting_unwritable_folder
from dreamfleet.common.files.file_system import file_system_type, is_network, lock_problem
from dreamfleet.common.protocol.keys import check_run_name
from dreamfleet.common.protocol.messages import Intervals
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_lock import run_lock
from dreamfleet.common.runs.run_paths import ARCHIVE, BUNDLE, JOURNAL, resume_command
from dreamfleet.common.security.certificate_ledger import RevocationWatcher
from dreamfleet.common.security.credentials import Credentials
from dreamfleet.common.transport.session import Network
from dreamfleet.common.worlds.score_words import score_word
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.service.service import Service
from dreamfleet.coordinator.settings.config import DEFAULT_BUNDLE, LimitsConfig, NetworkConfig, RunConfig
from dreamfleet.coordinator.settings.environment_check import check_environment
from dreamfleet.coordinator.settings.resume_settings import serving_facts
from dreamfleet.coordinator.settings.start import SUBSPACE_FACT, StartPoint
from dreamfleet.coordinator.storage.file_watch import FileWatch
from dreamfleet.coordinator.storage.journal import Journal
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

    @property
    def folder(self) -> Path:
        """The run's folder."""
        return self.runs_dir / check_run_name(self.name)

    @property
    def with_absolute_paths(self) -> RunRequest:
        """The same request with absolute paths, which hold in any working directory."""
        access = self.access_dir if self.access_dir == GlobalConfig.access_dir else self.access_dir.absolute()
        join = None if self.join is None else self.join.absolute()
        return replace(self, runs_dir=self.runs_dir.absolute(), join=join, access_dir=access)

    def resume_command(self, folder: Path | None = None) -> str:
        """The command that continues the run, also in a `folder` that it was moved to."""
        own_access_dir = None if self.access_dir == GlobalConfig.access_dir else self.access_dir
        return resume_command(folder or self.folder, self.join, own_access_dir, self.trust)


def serve_run(request: RunRequest, on_stoppable: Callable[[Callable[[], None]], None] = lambda _stop: None) -> Run:
    """Serve a new or continued run until it ends or is stopped; `on_stoppable` receives the function that stops it."""
    folder = request.folder
    if request.config is not None and request.name == ARCHIVE:
        raise UsageError(f"{ARCHIVE!r} is where archived runs lie: choose another name")
    _check_file_system(folder)
    settings, bundle = _resolve_settings(request, folder)
    with reporting_unwritable_folder(request.runs_dir, "choose another --runs-dir", JournalError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    with run_lock(folder), ExitStack() as stack:
        journal = stack.enter_context(closing(_open_journal(request, folder, settings, bundle)))
        served = stack.enter_context(closing(ServedBundle(folder / BUNDLE))) if bundle else None
        file_watch = stack.enter_context(
            closing(FileWatch(journal, served, request.with_absolute_paths.resume_command))
        )
        service = _service(request, file_watch, served, _score_word(settings, bundle))
        on_stoppable(service.stop)
        try:
            return service.serve(lambda: Run(journal, settings, request.limits, request.network, monotonic()))
        except JournalError as error:
            if not isinstance(error.__cause__, (OSError, sqlite3.OperationalError)) or not journal.is_whole:
                raise
            raise JournalError(f"{error}; continue it with: {request.resume_command()}") from error
        except ConnectionFailedError as error:
            if request.config is None:
                raise
            raise ConnectionFailedError(
                f"{error}; the run was created; start it with: {request.resume_command()}"
            ) from error


def _check_file_system(folder: Path) -> None:
    """`JournalError` if the run's file system keeps no locks; a warning if other hosts may share it."""
    if problem := lock_problem(folder):
        raise JournalError(problem)
    if is_network(kind := file_system_type(folder)):
        log.warning("%s is on a network file system (%s): read this run's files on this host alone, or a `runs backup`",
                    folder, kind)  # fmt: skip


def _score_word(settings: RunSettings, bundle: Bundle | None) -> str:
    task = settings.task.task
    return score_word(task) if bundle is None else score_word(bundle.manifest.task, bundle.manifest.world)


def _service(request: RunRequest, file_watch: FileWatch, bundle: ServedBundle | None, word: str) -> Service:
    network = request.network
    intervals = Intervals(network.beat, network.beat)
    revocations = RevocationWatcher(request.access_dir, request.credentials)
    reached = Network(network.listen, network.connect, request.credentials, revocations.revoked_seats)
    return Service(request.name, reached, intervals, file_watch, bundle, network.metrics_port, revocations, word)


def _open_journal(request: RunRequest, folder: Path, settings: RunSettings, bundle: Bundle | None) -> Journal:
    """Open the run's journal and write its limits, network settings and, of a new run, its start point.

    They are durable before anything else can fail: a coordinator that finds its port taken, or is killed, resumes with
    all its settings.
    """
    facts = serving_facts(request.limits, request.network)
    if request.config is not None:
        start = request.start.facts if request.start else {}
        loaded_subspace = {SUBSPACE_FACT: request.config.loaded_subspace.text} if request.config.loaded_subspace else {}
        return Journal.create(folder, settings, bundle.path if bundle else None, {**facts, **start, **loaded_subspace})
    journal = Journal(folder / JOURNAL)
    for name, text in facts.items():
        journal.set_fact(name, text)
    journal.commit()
    return journal


def _resolve_settings(request: RunRequest, folder: Path) -> tuple[RunSettings, Bundle | None]:
    """The run's settings, and its verified bundle if its task needs one."""
    if request.config is not None:
        return _resolve_new_settings(request.config, request.start, strict=request.network.strict)
    with open_run(request.runs_dir, request.name) as stored:
        settings = stored.settings
    if not settings.task.bundle:
        return settings, None
    return settings, Bundle.open(folder / BUNDLE, settings.task.bundle)


def _resolve_new_settings(
    config: RunConfig, start: StartPoint | None, *, strict: bool
) -> tuple[RunSettings, Bundle | None]:
    if start is not None and config.needs_no_bundle == (not start.bundle):
        config = start.apply_to(config)
    bundle = None if config.needs_no_bundle else find_bundle(config.bundle or DEFAULT_BUNDLE)
    config = check_environment(config, bundle, strict=strict)
    settings = config.settings(bundle)
    if start is not None:
        start.check(settings)
    return settings, bundle
