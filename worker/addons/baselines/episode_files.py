"""A training's episodes on disk, one file each: a resumed training refills its replay buffer from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.archives import ArchiveLimits, read_arrays
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.worker.addons.baselines.replay_buffer import Episode
from dreamfleet.worker.training.data.data_folder import explain_write_errors

_LIMITS = ArchiveLimits(4 << 30, members=4)
NAMES = ("picture", "choice", "reward", "terminal")


def episode_file(folder: Path, number: int) -> Path:
    """The path of an episode's file."""
    return folder / "replay" / f"{number:06d}.npz"


def save_episode(folder: Path, number: int, episode: Episode) -> None:
    """Write an episode atomically; `DatasetError` if it cannot be written."""
    path = episode_file(folder, number)
    with explain_write_errors(path), atomic_write(path) as file:
        np.savez_compressed(file, **{name: np.asarray(getattr(episode, name)) for name in NAMES})  # type: ignore[arg-type]


def load_episode(folder: Path, number: int, picture: int) -> Episode:
    """Read an episode whose pictures have this side; `DatasetError` for a missing or damaged file, or another size."""
    path = episode_file(folder, number)
    try:
        arrays = read_arrays(path, _LIMITS, NAMES)
        episode = Episode(arrays["picture"], arrays["choice"], arrays["reward"], bool(arrays["terminal"]))
        _check(episode, picture)
    except (OSError, ValueError, TypeError) as error:
        raise DatasetError(f"{path} is missing or damaged ({error}): give --new to start over") from error
    return episode


def delete_episodes_before(folder: Path, first: int) -> None:
    """Delete the files of the episodes with numbers below `first`."""
    for path in (folder / "replay").glob("[0-9]*.npz"):
        if path.stem < f"{first:06d}":
            path.unlink(missing_ok=True)


def _check(episode: Episode, picture: int) -> None:
    length = len(episode)
    wanted = ((length, picture, picture, 3), (length,), (length,))
    kinds = tuple(each.dtype.name for each in (episode.picture, episode.choice, episode.reward))
    if (episode.picture.shape, episode.choice.shape, episode.reward.shape) != wanted or not length:
        raise ValueError("its arrays are of other shapes")
    if kinds != ("uint8", "int64", "float32"):
        raise ValueError("its arrays hold something else")
