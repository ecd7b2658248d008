"""The preset that a data set was begun with: its folder keeps it, and a later verb that forgets it is told."""

from __future__ import annotations

import json
from pathlib import Path

from dreamfleet.common.cli.presets import check_preset
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.files.atomic_write import atomic_write, reporting_unwritable_folder
from dreamfleet.common.files.regular_files import read_text

NAME = "preset.json"
DEFAULT = "tiny"
MOST_BYTES = 1000


def store_preset(folder: Path, preset: str, seed: int) -> None:
    """Keep the preset and the seed of a data set that is begun now; one that has rollouts already stays as it is.

    `DatasetError` where nothing can be written.
    """
    path = folder / NAME
    if not path.exists() and not any((folder / "episodes").glob("[0-9]*.npz")):
        with reporting_unwritable_folder(folder, "choose another --data"), atomic_write(path) as file:
            file.write(json.dumps({"preset": preset, "seed": seed}).encode())


def load_preset(folder: Path) -> str | None:
    """The preset of a data set; one from before they were kept, or of no `collect`, has none."""
    path = folder / NAME
    if not path.exists():
        return None
    try:
        told = json.loads(read_text(path, MOST_BYTES))["preset"]
        return check_preset("training", told if isinstance(told, str) else repr(told))
    except (OSError, ValueError, KeyError, TypeError, RecursionError, UsageError) as error:
        raise DatasetError(
            f"{path} names no preset ({error}); write the one that collected the data into it"
        ) from error


def check_seed(folder: Path, seed: int) -> None:
    """`UsageError` for another seed than the data set was begun with; one from before seeds were kept has none."""
    if load_preset(folder) is None:
        return
    own = json.loads(read_text(folder / NAME, MOST_BYTES)).get("seed", seed)
    if own != seed:
        raise UsageError(
            f"{folder} was begun with --seed {own}, and this is --seed {seed}: give --seed {own} to go on with it, or "
            "another --data"
        )


def resolve_preset(folder: Path, given: str | None) -> str:
    """The preset that a verb goes by, tiny where none is given; `UsageError` if the data set was begun with another."""
    chosen, own = check_preset("training", given or DEFAULT), load_preset(folder)
    if own not in (None, chosen):
        told = f"--preset {given} is another" if given else f"without --preset it would be {DEFAULT}"
        raise UsageError(
            f"{folder} was begun with the preset {own}, and {told}: give --preset {own}; for other layers on the same "
            f"drives, add flags or train in a folder of its own that leads to {folder / 'episodes'}"
        )
    return chosen
