"""Collect rollouts, one compressed `.npz` per episode: driven here as pure functions of (seed, number), or imported."""

import shutil
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, NoReturn

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import hash_file
from dreamfleet.common.errors import DatasetError, DreamfleetError
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.host.process_pool import count_step, map_in_processes
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.host.unseen_drawing import draw_unseen
from dreamfleet.common.printable import plural
from dreamfleet.worker.scoring.episode import EpisodeConfig, ResetHook, run_episode
from dreamfleet.worker.scoring.failure_cause import crash, failure_of
from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD, DataWorld, Rollout, write_episode
from dreamfleet.worker.scoring.scorer import DRIVER_NAME
from dreamfleet.worker.tasks.api import Policy
from dreamfleet.worker.tasks.closing import close_environment, closing_environment
from dreamfleet.worker.tasks.model_free_policies import ALL_DRIVERS, DriverPolicy
from dreamfleet.worker.tasks.recordable import RecordableTask, TaskWithBeginnings
from dreamfleet.worker.training.data import dataset
from dreamfleet.worker.training.data.collect_config import CollectConfig, source_policies
from dreamfleet.worker.training.data.data_folder import explain_folder_errors, explain_write_errors
from dreamfleet.worker.training.data.pilot import Pilot

Environment = gymnasium.Env[Any, Any]
EnvironmentFor = Callable[[RecordableTask, str], AbstractContextManager[Environment]]
STALL = 300.0  # seconds without a step, after which a drive is given up; a long one is compressed in that time
MOST_REWARD = float(np.finfo(np.float32).max)
_kept: tuple[Environment, Finalize] | None = None  # in a process of the pool


def missing_numbers(folder: Path, config: CollectConfig) -> list[int]:
    """The numbers of the episodes that are still missing."""
    return [number for number in range(config.episodes) if not dataset.episode_path(folder, number).exists()]


def collect(
    folder: Path, config: CollectConfig, jobs: int, pilots: Sequence[Pilot] = (), world: DataWorld = OF_FIRST_WORLD,
    stall: float = STALL,
) -> Generator[int, None, None]:  # fmt: skip
    """Drive the missing episodes in `jobs` processes; yield the frames of each once it is written.

    Random drivers drive, or `pilots` in turn; `config` is of the world, as `check_for` says. Before any drive it raises
    `DatasetError` if existing episodes are of another world or have other pictures, and `ControllerError` if a pilot
    does. When closed early, it waits until running drives are written. `DreamfleetError` for a drive that fails, ends
    its process, or makes no step for `stall` seconds.
    """
    preprocessing = dataset.preprocessing_of_size(config.picture, world)
    dataset.check_pictures(dataset.existing_episodes(folder), config.picture, world, preprocessing)
    for pilot in pilots:
        pilot.check(preprocessing.name, world)
    numbers = missing_numbers(folder, config)
    with explain_folder_errors(folder):
        (folder / "episodes").mkdir(parents=True, exist_ok=True)
    if not numbers:
        return
    pin_thread_pools()
    absolute = folder.absolute()  # a simulator may change the current folder of its process
    drive = partial(_collect_one, absolute, config, pilots, world)
    yield from map_in_processes(jobs, draw_unseen, (), drive, numbers, _lose, stall)


def _lose(number: int, reason: int | str) -> NoReturn:
    raise DreamfleetError(
        f"drive {number} failed: {crash(reason).text}; what was written before is whole, and `dreamfleet doctor` "
        "looks for a cause in this host"
    )


def _collect_one(folder: Path, config: CollectConfig, pilots: Sequence[Pilot], world: DataWorld, number: int) -> int:
    try:
        arrays = drive_episode(config, number, pilots, world, kept_environment)
    except (DreamfleetError, MemoryError):
        raise
    except BaseException as error:  # a simulator may raise anything, also `SystemExit`
        raise DreamfleetError(f"drive {number} failed: {failure_of(error).text}") from error
    path = dataset.episode_path(folder, number)
    with explain_write_errors(path), atomic_write(path) as file:
        write_episode(file, arrays)
    return len(arrays["action"])


def fresh_environment(task: RecordableTask, preprocessing: str) -> AbstractContextManager[Environment]:
    """An environment for one drive."""
    return closing_environment(task.make_recorded(preprocessing))  # a game of its own process would go on


@contextmanager
def kept_environment(task: RecordableTask, preprocessing: str) -> Iterator[Environment]:
    """This process's environment for all its drives: some games take longer to start than a drive takes.

    It is closed when a drive fails, and as the process ends. A process drives in one world and preprocessing.
    """
    global _kept  # noqa: PLW0603 - a process of the pool has no other memory
    if _kept is None:
        environment = task.make_recorded(preprocessing)
        _kept = environment, Finalize(None, close_environment, (environment,), exitpriority=1)
    environment, close = _kept
    try:
        yield environment
    except BaseException:
        _kept = None
        close()
        raise


def drive_episode(
    config: CollectConfig, number: int, pilots: Sequence[Pilot] = (), world: DataWorld = OF_FIRST_WORLD,
    environment_for: EnvironmentFor = fresh_environment,
) -> dict[str, NDArray[Any]]:  # fmt: skip
    """Drive an episode of T steps: `picture` (T, side, side, 3) before each `action` (T, A), then `reward` (T,)."""
    random = np.random.default_rng([config.seed, number])
    task = dataset.find_world(*world)
    name, policy = _driver(task, config, number, pilots, random)
    preprocessing = dataset.preprocessing_of_size(config.picture, world)
    begin = _begin_hook(task, config.anywhere, random)
    episode_config = EpisodeConfig(int(random.integers(2**20, 2**31)), config.steps, config.patience)
    rollout = Rollout(name, preprocessing.name, world)
    with environment_for(task, preprocessing.name) as environment:
        for moment in run_episode(environment, policy, episode_config, begin):
            count_step()
            if not abs(moment.reward) <= MOST_REWARD:  # also NaN
                raise DatasetError(f"step {moment.step} of drive {number} gave the reward {moment.reward}")
            rollout.add(moment.seen, moment.action, moment.reward)
            rollout.ended, rollout.terminal = moment.ended, moment.terminal
    return rollout.arrays()


def _begin_hook(task: RecordableTask, share: float, random: np.random.Generator) -> ResetHook | None:
    """Begins this share of the drives at a random place; without such places there is nothing to draw."""
    if not isinstance(task, TaskWithBeginnings):
        return None
    begin = task.begin_anywhere
    return lambda environment, observation: begin(environment, random) if random.random() < share else observation


def _driver(
    task: RecordableTask, config: CollectConfig, number: int, pilots: Sequence[Pilot], random: np.random.Generator
) -> tuple[str, Policy]:
    """The driver of this episode: its name, and its policy with the episode begun."""
    if pilots:
        pilot = pilots[number % len(pilots)]
        return DRIVER_NAME, pilot.policy(config.noise, config.spells, int(random.integers(2**63)))
    if config.driver in (policies := source_policies(task)):
        policy = policies[config.driver](random)
        policy.begin(np.zeros(0, dtype=np.float32))
        return config.driver, policy
    name = list(task.drivers)[number % len(task.drivers)] if config.driver == ALL_DRIVERS else config.driver
    return name, DriverPolicy(task.drivers[name](random))


def import_rollouts(folder: Path, rollouts: Sequence[Path]) -> Iterator[int]:
    """Copy the rollouts that the data set lacks, compared by their bytes, under the next numbers; yield their frames.

    `DatasetError` before any copy if the drives, the data set's included, have different worlds or preprocessings.
    """
    there = dataset.existing_episodes(folder)
    _check_one_kind(folder, [*there, *rollouts])
    sizes = {path.stat().st_size for path in rollouts if path.exists()}
    known = {hash_file(path) for path in there if path.stat().st_size in sizes}
    number = int(there[-1].stem) + 1 if there else 0
    for path in rollouts:
        frames = _check_drive(path)
        if (identity := hash_file(path)) in known:
            continue
        known.add(identity)
        with (
            explain_folder_errors(folder),
            path.open("rb") as source,
            atomic_write(dataset.episode_path(folder, number)) as target,
        ):
            shutil.copyfileobj(source, target)
        number += 1
        yield frames


def _check_one_kind(folder: Path, drives: Sequence[Path]) -> None:
    """`DatasetError` names two drives, or the folder and a drive, that are of two worlds or have other pictures."""
    kinds = {path: dataset.kind_of(path) for path in drives}
    own = dataset.find_own_world(folder)
    worlds = ({own: folder} if own else {}) | {world: path for path, (world, _) in kinds.items()}
    if len(worlds) > 1:
        found = " and ".join(f"of {world} ({path})" for world, path in worlds.items())
        raise DatasetError(f"a data set has one world, and these are {found}; {dataset.REMEDY}")
    pictures = {name: path for path, (_, name) in kinds.items()}
    if len(pictures) > 1:
        found = " and ".join(f"{name!r} ({path})" for name, path in pictures.items())
        raise DatasetError(f"a data set's pictures must be of one kind, and these are {found}; {dataset.REMEDY}")


def _check_drive(path: Path) -> int:
    """Check a drive, which an untrusted worker may have sent, and return its number of frames."""
    frames = len(dataset.load_pictures(path))
    dataset.load_arrays(path, "driver")
    if len(dataset.load_steps(path)["reward"]) != frames:
        raise DatasetError(
            f"{path} holds {plural(frames, 'picture')} and another number of actions or rewards; delete it"
        )
    return frames
