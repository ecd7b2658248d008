"""From a request to a served run: the folder, its lock, its journal, the service."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

from dreamfleet.common.bundle import Bundle, find_bundle
from dreamfleet.common.errors import JournalError
from dreamfleet.common.keys import check_run_name
from dreamfleet.common.messages import Intervals
from dreamfleet.common.runs import BUNDLE, RunSettings, open_run, run_lock
from dreamfleet.common.session import Network
from dreamfleet.coordinator.config import DEFAULT_BUNDLE, LimitsConfig, NetworkConfig, RunConfig
from dreamfleet.coordinator.fleet import Fleet
from dreamfleet.coordinator.journal import Journal
from dreamfleet.coordinator.kept import facts_of
from dreamfleet.coordinator.run import Run
from dreamfleet.coordinator.service import Service
from dreamfleet.coordinator.start import Start


@dataclass(frozen=True)
class RunRequest:
    """What to serve; without `config` the run is continued."""

    name: str
    runs_dir: Path
    config: RunConfig | None
    limits: LimitsConfig
    network: NetworkConfig
    start: Start | None = None  # of a new run; it begins with zero parameters otherwise


def serve_run(request: RunRequest, on_stoppable: Callable[[Callable[[], None]], None] = lambda _stop: None) -> Run:
    """Serve a new or continued run until it ends or is stopped; `on_stoppable` is handed the way to stop it."""
    folder = request.runs_dir / check_run_name(request.name)
    settings, bundle = _settle(request, folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise JournalError(
            f"cannot write in {request.runs_dir}: {error.strerror}; choose another --runs-dir"
        ) from error
    with run_lock(folder):
        if request.config is None:
            journal = Journal(folder / "journal.sqlite")
        else:
            journal = Journal.create(folder, settings, bundle.path if bundle else None)
        service = _service(request, folder)
        on_stoppable(service.stop)
        try:
            _keep(journal, request)
            fleet = Fleet(request.network.beat, request.network.evaluation_share)
            return service.serve(lambda: Run(journal, settings, request.limits, fleet, monotonic(), request.start))
        finally:
            journal.close()


def _service(request: RunRequest, folder: Path) -> Service:
    network = request.network
    intervals = Intervals(network.beat, network.beat)
    return Service(request.name, folder, Network(network.listen, network.connect), intervals, mixed=network.mixed)


def _keep(journal: Journal, request: RunRequest) -> None:
    """Write how the run is served, at once: a coordinator that finds its port taken is not asked everything again."""
    for name, text in facts_of(request.limits, request.network).items():
        journal.set_fact(name, text)
    journal.commit()


def _settle(request: RunRequest, folder: Path) -> tuple[RunSettings, Bundle | None]:
    """What the run is, and its verified bundle if it has one."""
    if request.config is not None:
        return _settle_new(request.config, request.start)
    with open_run(request.runs_dir, request.name) as stored:
        settings = stored.settings
    if not settings.task.bundle:
        return settings, None
    bundle = Bundle.open(folder / BUNDLE)
    if bundle.sha256 != settings.task.bundle:
        raise JournalError(f"{bundle.path} is not the bundle that this run was started with; restore the folder")
    return settings, bundle


def _settle_new(config: RunConfig, start: Start | None) -> tuple[RunSettings, Bundle | None]:
    if start is not None and config.needs_no_bundle:
        config = start.under(config)
    bundle = None if config.needs_no_bundle else find_bundle(config.bundle or DEFAULT_BUNDLE)
    settings = config.settings(bundle)
    if start is not None:
        start.check(settings)
    return settings, bundle
