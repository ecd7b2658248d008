"""The folder of a data set: the preset and seed it was begun with, and errors of writing there."""

from __future__ import annotations

import errno
import json
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from dreamfleet.common.cli.presets import check_preset
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.files.atomic_write import atomic_write, reporting_unwritable_folder
from dreamfleet.common.files.regular_files import read_text

NAME = "preset.json"
DEFAULT = "tiny"
MOST_BYTES = 1000


def store_preset(folder: Path, preset: str, seed: int) -> None:
    """Store the preset and the seed of a new data set; do nothing for one that has rollouts already.

    `DatasetError` if it cannot be written.
    """
    path = folder / NAME
    if not path.exists() and not any((folder / "episodes").glob("[0-9]*.npz")):
        with explain_folder_errors(folder), atomic_write(path) as file:
            file.write(json.dumps({"preset": preset, "seed": seed}).encode())


def load_preset(folder: Path) -> str | None:
    """The preset of a data set; `None` for old data sets, and for those without `collect`."""
    path = folder / NAME
    if not path.exists():
        return None
    try:
        stored = json.loads(read_text(path, MOST_BYTES))["preset"]
        return check_preset("training", stored if isinstance(stored, str) else repr(stored))
    except (OSError, ValueError, KeyError, TypeError, RecursionError, UsageError) as error:
        raise DatasetError(
            f"{path} names no preset ({error}); write the one that collected the data into it"
        ) from error


def check_seed(folder: Path, seed: int) -> None:
    """`UsageError` if the data set was begun with another seed; old data sets have stored none."""
    if load_preset(folder) is None:
        return
    own = json.loads(read_text(folder / NAME, MOST_BYTES)).get("seed", seed)
    if own != seed:
        raise UsageError(
            f"{folder} was begun with --seed {own}, and this is --seed {seed}: give --seed {own} to go on with it, or "
            "another --data"
        )


def resolve_preset(folder: Path, given: str | None) -> str:
    """The preset to use: the given one, or tiny; `UsageError` if the data set was begun with another."""
    chosen, own = check_preset("training", given or DEFAULT), load_preset(folder)
    if own not in (None, chosen):
        reason = f"--preset {given} is another" if given else f"without --preset it would be {DEFAULT}"
        raise UsageError(
            f"{folder} was begun with the preset {own}, and {reason}: give --preset {own}; for other layers on the "
            f"same drives, add flags or train in another folder that links to {folder / 'episodes'}"
        )
    return chosen


FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)


def explain_folder_errors(folder: Path) -> AbstractContextManager[None]:
    """Raise an `OSError` as a `DatasetError` that asks for another data folder than `folder`."""
    return reporting_unwritable_folder(folder, "choose another --data")


@contextmanager
def explain_write_errors(path: Path) -> Iterator[None]:
    """Raise an `OSError` of writing `path` as a `DatasetError` that says how to resume."""
    try:
        yield
    except OSError as error:
        raise DatasetError(
            f"cannot write {path}: {error.strerror}; nothing that was saved before is lost: "
            f"{'make it writable' if error.errno in FORBIDDEN else 'make room there'}, and the same command (without "
            "--new, where it had that) goes on"
        ) from error
