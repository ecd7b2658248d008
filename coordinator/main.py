"""From a request to a served run: the folder, its lock, its journal, the service."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.credentials import Credentials
from dreamfleet.common.errors import ConnectionFailedError, JournalError, UsageError
from dreamfleet.common.keys import check_run_name
from dreamfleet.common.ledger import Revocations
from dreamfleet.common.messages import Intervals
from dreamfleet.common.runs import ARCHIVE, BUNDLE, JOURNAL, open_run, run_lock
from dreamfleet.common.session import Network
from dreamfleet.common.site import SiteConfig
from dreamfleet.common.store import find_bundle
from dreamfleet.common.stored import RunSettings
from dreamfleet.coordinator.config import DEFAULT_BUNDLE, LimitsConfig, NetworkConfig, RunConfig
from dreamfleet.coordinator.custody import Custody
from dreamfleet.coordinator.fleet import Fleet
from dreamfleet.coordinator.journal import Journal
from dreamfleet.coordinator.kept import again, facts_of
from dreamfleet.coordinator.run import Run
from dreamfleet.coordinator.served import ServedBundle
from dreamfleet.coordinator.service import Service
from dreamfleet.coordinator.start import SUBSPACE, Start


@dataclass(frozen=True)
class RunRequest:
    """What to serve; without `config` the run is continued."""

    name: str
    runs_dir: Path
    config: RunConfig | None
    limits: LimitsConfig
    network: NetworkConfig
    start: Start | None = None  # of a new run; it begins with zero parameters otherwise
    credentials: Credentials | None = None
    join: Path | None = None  # the file of the credentials
    access_dir: Path = SiteConfig.access_dir  # whose list says what is revoked

    @property
    def folder(self) -> Path:
        """Where the run lies."""
        return self.runs_dir / check_run_name(self.name)

    @property
    def anywhere(self) -> RunRequest:
        """The same with paths that hold in whichever folder somebody is."""
        access = self.access_dir if self.access_dir == SiteConfig.access_dir else self.access_dir.absolute()
        join = None if self.join is None else self.join.absolute()
        return replace(self, runs_dir=self.runs_dir.absolute(), join=join, access_dir=access)

    def again(self, folder: Path | None = None) -> str:
        """The command that continues the run, also in a `folder` that it was moved to."""
        return again(folder or self.folder, self.join, self.access_dir)


def serve_run(request: RunRequest, on_stoppable: Callable[[Callable[[], None]], None] = lambda _stop: None) -> Run:
    """Serve a new or continued run until it ends or is stopped; `on_stoppable` is handed the way to stop it."""
    folder = request.folder
    if request.config is not None and request.name == ARCHIVE:
        raise UsageError(f"{ARCHIVE!r} is where archived runs lie: choose another name")
    settings, bundle = _settle(request, folder)
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise JournalError(
            f"cannot write in {request.runs_dir}: {error.strerror}; choose another --runs-dir"
        ) from error
    with run_lock(folder), ExitStack() as stack:
        journal = stack.enter_context(closing(_open(request, folder, settings, bundle)))
        served = stack.enter_context(closing(ServedBundle(folder / BUNDLE))) if bundle else None
        custody = stack.enter_context(closing(Custody(journal, served, request.anywhere.again)))
        service = _service(request, custody, served)
        on_stoppable(service.stop)
        fleet, strict = Fleet(request.network.beat, request.network.evaluation_share), request.network.strict
        try:
            return service.serve(lambda: Run(journal, settings, request.limits, fleet, monotonic(), strict=strict))
        except ConnectionFailedError as error:
            if request.config is None:
                raise
            raise ConnectionFailedError(f"{error}; the run is made, and begins with: {request.again()}") from error


def _service(request: RunRequest, custody: Custody, bundle: ServedBundle | None) -> Service:
    network = request.network
    intervals = Intervals(network.beat, network.beat)
    revocations = Revocations(request.access_dir, request.credentials)
    reached = Network(network.listen, network.connect, request.credentials, revocations.barred)
    return Service(request.name, reached, intervals, custody, bundle, network.metrics_port, revocations)


def _open(request: RunRequest, folder: Path, settings: RunSettings, bundle: Bundle | None) -> Journal:
    """The run's journal, with how it is served.

    It is written before anything else can fail, as is where a new run begins, in the transaction that makes the run: a
    coordinator that finds its port taken, or is killed, is continued with all that it was told.
    """
    facts = facts_of(request.limits, request.network)
    if request.config is not None:
        start = request.start.facts if request.start else {}
        searched = {SUBSPACE: request.config.searched.text} if request.config.searched else {}
        return Journal.create(folder, settings, bundle.path if bundle else None, {**facts, **start, **searched})
    journal = Journal(folder / JOURNAL)
    for name, text in facts.items():
        journal.set_fact(name, text)
    journal.commit()
    return journal


def _settle(request: RunRequest, folder: Path) -> tuple[RunSettings, Bundle | None]:
    """What the run is, and its verified bundle if it has one."""
    if request.config is not None:
        return _settle_new(request.config, request.start)
    with open_run(request.runs_dir, request.name) as stored:
        settings = stored.settings
    if not settings.task.bundle:
        return settings, None
    return settings, Bundle.open(folder / BUNDLE, settings.task.bundle)


def _settle_new(config: RunConfig, start: Start | None) -> tuple[RunSettings, Bundle | None]:
    if start is not None and config.needs_no_bundle == (not start.bundle):
        config = start.under(config)
    bundle = None if config.needs_no_bundle else find_bundle(config.bundle or DEFAULT_BUNDLE)
    settings = config.settings(bundle)
    if start is not None:
        start.check(settings)
    return settings, bundle
