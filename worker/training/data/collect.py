"""Collecting rollouts: one compressed `.npz` an episode, each a pure function of (seed, number)."""

from __future__ import annotations

import os
from collections.abc import Generator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.files.atomic_write import atomic_write, reporting_unwritable_folder
from dreamfleet.common.host.parent_death import exit_with_parent, signals_blocked
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.scoring.rollout import Rollout, write_episode
from dreamfleet.worker.scoring.scorer import DRIVER_NAME
from dreamfleet.worker.tasks.api import Policy
from dreamfleet.worker.tasks.policy import ALL_DRIVERS, DriverPolicy
from dreamfleet.worker.training.data.collect_config import CollectConfig
from dreamfleet.worker.training.data.dataset import check_pictures
from dreamfleet.worker.training.data.disk_errors import explain_write_errors
from dreamfleet.worker.training.data.pilot import Pilot
from dreamfleet.worker.training.data.world import find_world, preprocessing_of_size, source_policies


def episode_path(folder: Path, number: int) -> Path:
    """Where an episode lies."""
    return folder / "episodes" / f"{number:06d}.npz"


def existing_episodes(folder: Path) -> list[Path]:
    """The episodes that are there, by number."""
    return sorted((folder / "episodes").glob("[0-9]*.npz"))


def missing_numbers(folder: Path, config: CollectConfig) -> list[int]:
    """Numbers of the episodes that are not there yet."""
    return [number for number in range(config.episodes) if not episode_path(folder, number).exists()]


def collect(folder: Path, config: CollectConfig, jobs: int, pilots: Sequence[Pilot] = ()) -> Generator[int, None, None]:
    """Drive the episodes that are not there yet in `jobs` processes; yields the frames of each as it is written.

    Random drivers drive them, or these pilots in turn. `DatasetError` or `ControllerError` before anything is driven if
    what is there has other pictures, or a pilot sees others. Closed early, it waits until those that are being driven
    are written.
    """
    check_pictures(existing_episodes(folder), config.picture)
    for pilot in pilots:
        pilot.check(preprocessing_of_size(config.picture).name)
    numbers = missing_numbers(folder, config)
    with reporting_unwritable_folder(folder, "choose another --data"):
        (folder / "episodes").mkdir(parents=True, exist_ok=True)
    if not numbers:
        return
    pin_thread_pools()
    pool = ProcessPoolExecutor(min(jobs, len(numbers)), get_context("spawn"), _start_process, (os.getpid(),))
    try:
        with signals_blocked():
            rollouts = [pool.submit(_collect_one, (folder, config, number, tuple(pilots))) for number in numbers]
        for each in as_completed(rollouts):
            yield each.result()
    except BrokenProcessPool as error:
        raise DreamfleetError("a process that drove has crashed; `dreamfleet doctor` looks for the cause") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _start_process(parent: int) -> None:
    exit_with_parent(parent)
    os.environ["SDL_VIDEODRIVER"] = "dummy"


def _collect_one(task: tuple[Path, CollectConfig, int, tuple[Pilot, ...]]) -> int:
    folder, config, number, pilots = task
    arrays = drive_episode(config, number, pilots)
    path = episode_path(folder, number)
    with explain_write_errors(path), atomic_write(path) as file:
        write_episode(file, arrays)
    return len(arrays["action"])


def drive_episode(config: CollectConfig, number: int, pilots: Sequence[Pilot] = ()) -> dict[str, NDArray[Any]]:
    """One episode of T steps: `picture` (T, side, side, 3) before each `action` (T, 3), then `reward` (T,)."""
    random = np.random.default_rng([config.seed, number])
    world = find_world()
    name, policy = _driver(config, number, pilots, random)
    preprocessing = preprocessing_of_size(config.picture)
    environment = world.make_recorded(preprocessing.name)
    episode_config = EpisodeConfig(int(random.integers(2**20, 2**31)), config.steps, config.patience)

    def begin(environment: gymnasium.Env[Any, Any], observation: Any) -> Any:
        return world.begin_anywhere(environment, random) if random.random() < config.anywhere else observation

    rollout = Rollout(name, preprocessing.name)
    for moment in run_episode(environment, policy, episode_config, begin):
        rollout.add(moment.seen, moment.action, moment.reward)
        rollout.ended = moment.ended
    environment.close()
    return rollout.arrays()


def _driver(
    config: CollectConfig, number: int, pilots: Sequence[Pilot], random: np.random.Generator
) -> tuple[str, Policy]:
    """Who drives this episode, by name and as a policy that has begun."""
    if pilots:
        pilot = pilots[number % len(pilots)]
        return DRIVER_NAME, pilot.policy(config.noise, config.spells, int(random.integers(2**63)))
    if config.driver in (policies := source_policies()):
        policy = policies[config.driver](random)
        policy.begin(np.zeros(0, dtype=np.float32))
        return config.driver, policy
    drivers = find_world().drivers
    name = list(drivers)[number % len(drivers)] if config.driver == ALL_DRIVERS else config.driver
    return name, DriverPolicy(drivers[name](random))
