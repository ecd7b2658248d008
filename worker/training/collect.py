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

from dreamfleet.common.children import die_with, signals_held
from dreamfleet.common.errors import DatasetError, DreamfleetError
from dreamfleet.common.files import write_aside
from dreamfleet.common.threads import pin_thread_pools
from dreamfleet.worker.scoring.episode import Course, play
from dreamfleet.worker.scoring.rollout import Rollout, write_episode
from dreamfleet.worker.scoring.scorer import DRIVER
from dreamfleet.worker.tasks.api import Policy
from dreamfleet.worker.tasks.policy import ALL, Driven
from dreamfleet.worker.training.collect_config import CollectConfig
from dreamfleet.worker.training.dataset import check_pictures
from dreamfleet.worker.training.pilot import Pilot
from dreamfleet.worker.training.room import told_where_full
from dreamfleet.worker.training.world import find_world, preprocessing_to, source_policies


def episode_path(folder: Path, number: int) -> Path:
    """Where an episode lies."""
    return folder / "episodes" / f"{number:06d}.npz"


def present(folder: Path) -> list[Path]:
    """The episodes that are there, by number."""
    return sorted((folder / "episodes").glob("[0-9]*.npz"))


def missing(folder: Path, config: CollectConfig) -> list[int]:
    """Numbers of the episodes that are not there yet."""
    return [number for number in range(config.episodes) if not episode_path(folder, number).exists()]


def collect(folder: Path, config: CollectConfig, jobs: int, pilots: Sequence[Pilot] = ()) -> Generator[int, None, None]:
    """Drive the episodes that are not there yet in `jobs` processes; yields the frames of each as it is written.

    Random drivers drive them, or these pilots in turn. `DatasetError` or `ControllerError` before anything is driven if
    what is there has other pictures, or a pilot sees others. Closed early, it waits until those that are being driven
    are written.
    """
    check_pictures(present(folder), config.picture)
    for pilot in pilots:
        pilot.check(preprocessing_to(config.picture).name)
    numbers = missing(folder, config)
    try:
        (folder / "episodes").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DatasetError(f"cannot write in {folder}: {error.strerror}; choose another --data") from error
    if not numbers:
        return
    pin_thread_pools()
    pool = ProcessPoolExecutor(min(jobs, len(numbers)), get_context("spawn"), _start_process, (os.getpid(),))
    try:
        with signals_held():
            rollouts = [pool.submit(_collect_one, (folder, config, number, tuple(pilots))) for number in numbers]
        for each in as_completed(rollouts):
            yield each.result()
    except BrokenProcessPool as error:
        raise DreamfleetError("a process that drove has crashed; `dreamfleet doctor` looks for the cause") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _start_process(parent: int) -> None:
    die_with(parent)
    os.environ["SDL_VIDEODRIVER"] = "dummy"


def _collect_one(task: tuple[Path, CollectConfig, int, tuple[Pilot, ...]]) -> int:
    folder, config, number, pilots = task
    arrays = drive(config, number, pilots)
    path = episode_path(folder, number)
    with told_where_full(path), write_aside(path) as file:
        write_episode(file, arrays)
    return len(arrays["action"])


def drive(config: CollectConfig, number: int, pilots: Sequence[Pilot] = ()) -> dict[str, NDArray[Any]]:
    """One episode of T steps: `picture` (T, side, side, 3) before each `action` (T, 3), then `reward` (T,)."""
    random = np.random.default_rng([config.seed, number])
    world = find_world()
    name, policy = _driver(config, number, pilots, random)
    preprocessing = preprocessing_to(config.picture)
    environment = world.make_recorded(preprocessing.name)
    course = Course(int(random.integers(2**20, 2**31)), config.steps, config.patience)

    def begin(environment: gymnasium.Env[Any, Any], observation: Any) -> Any:
        return world.begin_anywhere(environment, random) if random.random() < config.anywhere else observation

    rollout = Rollout(name, preprocessing.name)
    for moment in play(environment, policy, course, begin):
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
        return DRIVER, pilot.policy(config.noise, config.spells, int(random.integers(2**63)))
    if config.driver in (policies := source_policies()):
        policy = policies[config.driver](random)
        policy.begin(np.zeros(0, dtype=np.float32))
        return config.driver, policy
    drivers = find_world().drivers
    name = list(drivers)[number % len(drivers)] if config.driver == ALL else config.driver
    return name, Driven(drivers[name](random))
