"""Collecting: the missing drives of a data set, or rollouts that a run kept."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.errors import StoppedError, UsageError
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.host.stop_signals import Stop, never_stop
from dreamfleet.common.printable import plural
from dreamfleet.worker.training.stages import StageReport

if TYPE_CHECKING:
    from dreamfleet.worker.scoring.rollout import DataWorld
    from dreamfleet.worker.training.data.collect_config import CollectConfig
    from dreamfleet.worker.training.data.pilot import Pilot

OF_CONTROLLERS = ("noise", "spells")  # settings of their actions


@dataclass(frozen=True)
class CollectRequest:
    """The drives that a data set shall have. What is not given is as the data set was begun, else its world's default.

    `world` holds arguments of the task, as its `parse_options` takes them. `settings` are the fields of `CollectConfig`
    that differ from the preset's. `controllers` drive in turn: files, runs, or shipped ones; else random drivers do.
    """

    data: Path
    preset: str | None = None
    task: str | None = None
    world: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    jobs: int = field(default_factory=usable_cores)
    controllers: tuple[str, ...] = ()
    runs_dir: Path = Path("runs")

    def __post_init__(self) -> None:
        for name in OF_CONTROLLERS:
            if name in self.settings and not self.controllers:
                raise UsageError(f"--{name} is on a controller's actions: give --controller too")
        if "driver" in self.settings and self.controllers:
            raise UsageError("--driver is who drives at random: omit it or --controller")


@dataclass(frozen=True)
class ImportRequest:
    """The rollouts that a run kept, for a data set of their world."""

    data: Path
    run: str
    runs_dir: Path = Path("runs")


@dataclass(frozen=True)
class CollectReport(StageReport):
    """New drives and their frames, and the drives that the data set has now."""

    data: Path
    new_episodes: int
    new_frames: int
    episodes: int

    def __str__(self) -> str:
        return f"{self._new}; {plural(self.episodes, 'episode')} in all"

    @property
    def _new(self) -> str:
        return f"{self.data}: {plural(self.new_episodes, 'new episode')} with {plural(self.new_frames, 'frame')}"


@dataclass(frozen=True)
class ImportReport(CollectReport):
    """The same of rollouts, of `collected` that `run` kept."""

    collected: int
    run: str

    def __str__(self) -> str:
        return f"{self._new}, of {self.collected} that {self.run} collected"


def collect_drives(request: CollectRequest, stop: Stop = never_stop) -> CollectReport:
    """Drive what is missing, with a progress bar on stderr.

    `StoppedError` says what is kept; other errors are `UsageError`, `DatasetError`, `ControllerError`, and
    `DreamfleetError` for a drive that fails.
    """
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.worker.training.data.collect import collect, missing_numbers
    from dreamfleet.worker.training.data.data_folder import resolve_preset, resolve_world, store_preset
    from dreamfleet.worker.training.data.dataset import check_no_foreign_files, existing_episodes
    from dreamfleet.worker.training.presets import find_preset

    data = request.data
    check_no_foreign_files(data)
    world = resolve_world(data, request.task, request.world)
    preset = find_preset(resolve_preset(data, request.preset, world))
    config, pilots = replace(_fit_pictures(preset.collect, world), **request.settings), _load_pilots(request)
    config.check_for(world)  # a refused request begins no data set
    frames = done = 0
    before = len(existing_episodes(data))
    total = before + len(missing_numbers(data, config))
    with progress_bar("collect", total, "episodes") as bar:
        bar.update(before)
        store_preset(data, preset.name, config.seed, world)
        with closing(collect(data, config, max(1, request.jobs), pilots, world)) as counts:
            for count in counts:
                frames, done = frames + count, done + 1
                bar.update(before + done)
                if stop():
                    break
    there = len(existing_episodes(data))  # with those that were written while the others stopped
    if there < total:
        raise StoppedError(
            f"stopped: {data} keeps {plural(there - before, 'new episode')}, {there} of {total} in all; the same "
            "command continues"
        )
    return CollectReport(data, done, frames, there)


def _fit_pictures(config: CollectConfig, world: DataWorld) -> CollectConfig:
    """The configuration with the pictures of a world that has only one size of them."""
    from dreamfleet.worker.training.data.dataset import find_world

    sizes = {each.size for each in find_world(*world).preprocessings.values()}
    return replace(config, picture=sizes.pop()) if len(sizes) == 1 else config


def _load_pilots(request: CollectRequest) -> tuple[Pilot, ...]:
    if not request.controllers:
        return ()
    from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
    from dreamfleet.worker.training.data.pilot import Pilot

    found = []
    for name in request.controllers:
        controller, beside = find_controller(name, request.runs_dir)
        if (bundle := find_bundle_of(controller, None, beside)) is None:
            raise UsageError(f"controller {name} sees no world model: give one that was evolved with one")
        found.append(Pilot(controller, bundle))
    return tuple(found)


def import_kept(request: ImportRequest, _stop: Stop = never_stop) -> ImportReport:
    """Copy the rollouts that the data set lacks; `UsageError` if the run kept none, `DatasetError` if worlds differ."""
    from dreamfleet.common.runs.run_folder import open_run
    from dreamfleet.worker.training.data.collect import import_rollouts
    from dreamfleet.worker.training.data.dataset import existing_episodes

    with open_run(request.runs_dir, request.run) as stored:
        drives = stored.rollouts()
        if not drives:
            raise UsageError(f"run {request.run} has collected nothing: start a run with --collect-every")
    new = list(import_rollouts(request.data, drives))
    there = len(existing_episodes(request.data))
    return ImportReport(request.data, len(new), sum(new), there, len(drives), request.run)
