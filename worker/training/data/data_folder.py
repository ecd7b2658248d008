"""The folder of a data set: the preset, seed and world it was begun with, and errors of writing there."""

import errno
import json
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from dreamfleet.common.cli.presets import check_preset
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.files.atomic_write import atomic_write, reporting_unwritable_folder
from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD, DataWorld
from dreamfleet.worker.tasks.recordable import TaskWithOptions
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.training.data import dataset
from dreamfleet.worker.training.presets import find_preset


def store_preset(folder: Path, preset: str, seed: int, world: DataWorld = OF_FIRST_WORLD) -> None:
    """Store the preset, seed and world of a new data set; do nothing for one that has rollouts already.

    `DatasetError` if it cannot be written.
    """
    path = folder / dataset.BEGUN
    if not path.exists() and not dataset.existing_episodes(folder):
        own = {name: value for name, value in world._asdict().items() if value}
        with explain_folder_errors(folder), atomic_write(path) as file:
            file.write(json.dumps({"preset": preset, "seed": seed, **own}).encode())


def load_preset(folder: Path) -> str | None:
    """The preset of a data set; `None` for one that `collect` did not begin."""
    begun = dataset.load_begun(folder)
    try:
        return check_preset("training", begun["preset"]) if begun else None
    except UsageError as error:
        raise DatasetError(
            f"{folder / dataset.BEGUN} names no preset ({error}); write the one that collected the data into it"
        ) from error


def check_seed(folder: Path, seed: int) -> None:
    """`UsageError` if the data set was begun with another seed; one that `collect` did not begin has none."""
    own = dataset.load_begun(folder).get("seed", seed)
    if own != seed:
        raise UsageError(
            f"{folder} was begun with --seed {own}, and this is --seed {seed}: give --seed {own} to continue it, or "
            "another --data"
        )


def resolve_world(folder: Path, task: str | None, arguments: Mapping[str, Any]) -> DataWorld:
    """The world to collect in: the given task, or the data set's own, under the options in a verb's `arguments`.

    Without any it is the data set's own. `UsageError` if the data set is of another, or the task has no such options.
    """
    own = dataset.find_own_world(folder)
    if task is None and not arguments:
        return own or OF_FIRST_WORLD
    name, options = task or (own or OF_FIRST_WORLD).task, ""
    found = find_task(name)
    if isinstance(found, TaskWithOptions):
        options = found.parse_options(arguments)
    elif arguments:
        raise UsageError(f"task {name} has no options: omit {', '.join(f'--{each}' for each in arguments)}")
    given = DataWorld(name, options)
    if own not in (None, given):
        raise UsageError(
            f"{folder} holds data of {own}, and this is {given}: a data set has one world; {dataset.REMEDY}"
        )
    return given


def resolve_preset(folder: Path, given: str | None, world: DataWorld | None = None) -> str:
    """The preset to use: the given one, or that of the world, which is the data set's own unless one is given.

    `UsageError` if the data set was begun with another, or the preset is of another world.
    """
    world = world or dataset.world_of_folder(folder)
    default = dataset.find_world(*world).world.preset
    chosen, own = check_preset("training", given or default), load_preset(folder)
    if own not in (None, chosen):
        reason = f"--preset {given} is another" if given else f"without --preset it would be {default}"
        raise UsageError(
            f"{folder} was begun with the preset {own}, and {reason}: give --preset {own}; for other layers on the "
            f"same drives, add flags or train in another folder that links to {folder / 'episodes'}"
        )
    if (task := find_preset(chosen).task) not in ("", world.task):
        raise UsageError(f"the preset {chosen} is of {task}, and the data are of {world}: give --preset {default}")
    return chosen


FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)


def explain_folder_errors(folder: Path) -> AbstractContextManager[None]:
    """Raise an `OSError` as a `DatasetError` that asks for another data folder than `folder`."""
    return reporting_unwritable_folder(folder, dataset.REMEDY)


@contextmanager
def explain_write_errors(path: Path) -> Iterator[None]:
    """Raise an `OSError` of writing `path` as a `DatasetError` that says how to resume."""
    try:
        yield
    except OSError as error:
        raise DatasetError(
            f"cannot write {path}: {error.strerror}; nothing that was saved before is lost: "
            f"{'make it writable' if error.errno in FORBIDDEN else 'make room there'}, and the same command (without "
            "--new, where it had that) continues"
        ) from error
