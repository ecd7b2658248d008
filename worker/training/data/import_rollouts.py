"""Rollouts that a run collected, taken into a data set: each once, under the next free number."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from dreamfleet.common.artifacts.bundle import hash_file
from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.atomic_write import atomic_write, reporting_unwritable_folder
from dreamfleet.worker.training.data.collect import episode_path, existing_episodes
from dreamfleet.worker.training.data.dataset import load_arrays, load_pictures, load_steps, preprocessing_of


def import_rollouts(folder: Path, rollouts: Sequence[Path]) -> Iterator[int]:
    """Copy the rollouts that the data set lacks; yields the frames of each. Which it has, their bytes tell.

    `DatasetError` before anything is copied if not all pictures, the data set's among them, are of one preprocessing.
    """
    there = existing_episodes(folder)
    kinds = {preprocessing_of(path): path for path in (*there, *rollouts)}
    if len(kinds) > 1:
        told = " and ".join(f"{kind!r} ({path})" for kind, path in kinds.items())
        raise DatasetError(f"a data set's pictures are of one kind, and these are {told}; choose another --data")
    sizes = {path.stat().st_size for path in rollouts if path.exists()}
    known = {hash_file(path) for path in there if path.stat().st_size in sizes}
    number = int(there[-1].stem) + 1 if there else 0
    for path in rollouts:
        frames = _check(path)
        if (identity := hash_file(path)) in known:
            continue
        known.add(identity)
        with (
            reporting_unwritable_folder(folder, "choose another --data"),
            path.open("rb") as source,
            atomic_write(episode_path(folder, number)) as target,
        ):
            shutil.copyfileobj(source, target)
        number += 1
        yield frames


def _check(path: Path) -> int:
    """Frames of a drive; whatever a worker sent lies there, so it is looked at before anything trains on it."""
    frames = len(load_pictures(path))
    load_arrays(path, "driver")
    if len(load_steps(path)["reward"]) != frames:
        raise DatasetError(f"{path} holds {frames} pictures and another number of actions or rewards; delete it")
    return frames
