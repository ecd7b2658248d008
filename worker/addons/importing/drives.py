"""Recorded drives of other programs, as episodes of a data set of the first world.

WME's `record/*.npz` hold `obs` as uint8 and `action` as float16, the article's also `reward` and `done`. ctallec's hold
`observations`, `actions`, `rewards` and `terminals`. The last two show the bar below the scene too, and their steps are
shifted: the article's `reward` is that of the action before, and ctallec's picture is the one after its action.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.files.archives import NPY, ArchiveLimits, DamagedArchiveError, open_archive, parse_array
from dreamfleet.common.files.atomic_write import open_output
from dreamfleet.common.files.regular_files import open_regular
from dreamfleet.common.printable import plural
from dreamfleet.worker.addons.importing.sources import drive_paths
from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD, write_episode
from dreamfleet.worker.tasks.recordable import Preprocessing
from dreamfleet.worker.training.data.data_folder import explain_folder_errors, store_preset
from dreamfleet.worker.training.data.dataset import episode_path, existing_episodes, find_world, preprocessing_of_size

LIMITS = ArchiveLimits(512 << 20)  # bytes of a drive: 1,000 pictures of 96x96 as 64-bit numbers have 220 MB
NAMES = {
    "picture": ("obs", "observations", "observation"),
    "action": ("action", "actions"),
    "reward": ("reward", "rewards"),
    "done": ("done", "dones", "terminal", "terminals"),
}
ACTIONS = 3  # steering, gas, brake
MOST_STEPS = 20_000  # of a drive
SMALL, WHOLE = (64, 64, 3), (96, 96, 3)  # a picture that a world model sees, and an observation
Layout = Literal["dreamfleet", "wme", "article", "ctallec"]
WHOLE_PICTURES = "whole-64"  # of the article and of ctallec
FIRST_REWARD = -0.1  # which the article's program records before its first action
CTALLEC_NAME = re.compile(r"rollout_\d+\.npz", re.ASCII)


class Imported(NamedTuple):
    """What was written: drives, their steps, and drives whose rewards were not recorded."""

    drives: int
    steps: int
    without_rewards: int
    layouts: tuple[Layout, ...]  # that were found


class Drive(NamedTuple):
    """The arrays of one drive as an episode has them; without recorded rewards they are 0."""

    arrays: dict[str, NDArray[Any]]
    has_rewards: bool
    layout: Layout


def import_drives(source: Path, folder: Path, *, layout: Layout | None = None) -> Imported:
    """Write the drives of the `.npz` files of `source`, a file or folder, into an empty data folder.

    Pictures of 64x64 are taken as they are, and those of 96x96 as whole observations. `layout` says whose drives they
    are; by default each file does, as in `_layout_of`. `UsageError` for a data folder in use, `DatasetError` for a file
    that is no drive; what was written before it stays, and before a first drive nothing is.
    """
    if existing_episodes(folder):
        raise UsageError(f"{folder} holds drives: choose an empty --out")
    paths, layouts = drive_paths(source), set[Layout]()
    if not paths:
        raise DatasetError(f"{source} holds no .npz")
    steps = rewardless = 0
    for number, path in enumerate(paths):
        drive = read_drive(path, layout=layout)
        if not number:
            with explain_folder_errors(folder):
                (folder / "episodes").mkdir(parents=True, exist_ok=True)
            store_preset(folder, "paper", 0)
        steps, rewardless = steps + len(drive.arrays["action"]), rewardless + (not drive.has_rewards)
        layouts.add(drive.layout)
        with open_output(episode_path(folder, number)) as file:
            write_episode(file, drive.arrays)
    return Imported(len(paths), steps, rewardless, tuple(sorted(layouts)))


def read_drive(path: Path, *, layout: Layout | None = None) -> Drive:
    """One drive of a file; `DatasetError` if it is none."""
    found = dict(_read_arrays(path))
    layout = layout or _layout_of(path, found)
    steps = len(found["picture"]) if found["picture"].ndim else 0
    if layout == "ctallec":  # its program draws more actions than a drive that ends early has steps
        found["action"] = found["action"][:steps]
    action = _numbers(path, "actions", found["action"], (steps, ACTIONS), "biuf")
    rewards = _numbers(path, "rewards", found.get("reward", np.zeros(steps)), (steps,), "biuf")
    done = _numbers(path, "ends", found.get("done", np.zeros(steps, bool)), (steps,), "biu")
    whole = find_world().preprocessings[WHOLE_PICTURES]
    preprocessing = whole if layout in ("article", "ctallec") else preprocessing_of_size(SMALL[0])
    pictures = _pictures(path, found["picture"], preprocessing, minus_one=layout == "wme")
    if layout in ("article", "ctallec"):
        if steps < 2:
            raise DatasetError(f"{path}: a drive of {steps} step has no action between two pictures")
        pictures, rewards, done = pictures[:-1], rewards[1:], done[1:]
        action = action[1:] if layout == "ctallec" else action[:-1]
    drive: dict[str, NDArray[Any]] = {
        "picture": pictures, "action": action, "reward": rewards, "ended": np.array(bool(done[-1])),
        "driver": np.array("imported"), "preprocessing": np.array(preprocessing.name),
        "world": np.array(OF_FIRST_WORLD.text),
    }  # fmt: skip
    return Drive(drive, "reward" in found, layout)


def _layout_of(path: Path, found: Mapping[str, NDArray[Any]]) -> Layout:
    """Whose drive it is: WME's by its two arrays' types, the article's by its first reward, ctallec's by the name."""
    picture = found["picture"]
    if found.keys() == {"picture", "action"}:
        is_wme = picture.dtype == np.uint8 and picture.shape[1:] == SMALL and found["action"].dtype == np.float16
        return "wme" if is_wme else "dreamfleet"
    if CTALLEC_NAME.fullmatch(path.name) and len(found) == len(NAMES):
        return "ctallec"
    if "reward" not in found:
        return "dreamfleet"
    rewards = found["reward"]
    begins_before = rewards.ndim == 1 and rewards[:1].tolist() == [FIRST_REWARD]
    return "article" if begins_before and picture.dtype.kind == "f" and picture.shape[1:] == SMALL else "dreamfleet"


def _read_arrays(path: Path) -> Mapping[str, NDArray[Any]]:
    try:
        with open_regular(path, LIMITS.size) as file, open_archive(file, LIMITS) as archive:
            here = dict(_matching(archive.names))
            missing = [f"{own} ({' or '.join(NAMES[own])})" for own in ("picture", "action") if own not in here]
            if missing:
                raise DatasetError(f"{path} lacks {' and '.join(missing)}")
            return {own: parse_array(archive.read(name + NPY), name) for own, name in here.items()}
    except (OSError, DamagedArchiveError) as error:
        raise DatasetError(f"{path} is no drive that can be read ({error})") from error


def _matching(names: frozenset[str]) -> Iterator[tuple[str, str]]:
    for own, theirs in NAMES.items():
        for each in theirs:
            if each + NPY in names:
                yield own, each
                break


def _numbers(path: Path, what: str, found: NDArray[Any], shape: tuple[int, ...], kinds: str) -> NDArray[np.float32]:
    """An array of this shape as float32, `(T, 1)` as `(T,)`; `DatasetError` for other types, NaN or infinity."""
    if found.dtype.kind not in kinds:
        raise DatasetError(f"{path}: {what} are of type {found.dtype}, not numbers")
    if found.shape not in (shape, (*shape, 1)):
        raise DatasetError(
            f"{path}: {what} {found.shape} do not fit {plural(shape[0], 'picture')}: they must be {shape}"
        )
    with np.errstate(over="ignore"):
        numbers = found.reshape(shape).astype(np.float32)
    if not np.isfinite(numbers).all():
        raise DatasetError(f"{path}: {what} hold NaN or infinity")
    return numbers


def _pictures(
    path: Path, pictures: NDArray[Any], preprocessing: Preprocessing, *, minus_one: bool
) -> NDArray[np.uint8]:
    if pictures.ndim != 4 or pictures.shape[1:] not in (SMALL, WHOLE) or not len(pictures):
        raise DatasetError(f"{path}: pictures are (steps, 64, 64, 3) or (steps, 96, 96, 3), not {pictures.shape}")
    if len(pictures) > MOST_STEPS:
        raise DatasetError(f"{path}: a drive has at most {MOST_STEPS:,} steps, not {len(pictures):,}")
    kind = pictures.dtype.kind
    if kind not in "uif" or not (np.isfinite(pictures).all() if kind == "f" else True):
        raise DatasetError(f"{path}: pictures hold NaN or infinity, or are of type {pictures.dtype}, not numbers")
    if pictures.min() < 0 or pictures.max() > 255:
        raise DatasetError(f"{path}: pictures have values from 0 to 255, not {pictures.min()} to {pictures.max()}")
    if minus_one and pictures.dtype != np.uint8:
        raise DatasetError(f"{path}: pictures of the layout wme are of type uint8, not {pictures.dtype}")
    scale = 255 if kind == "f" and pictures.max() <= 1 else 1
    whole = np.stack([np.round(each * scale) if kind == "f" else each for each in pictures]).astype(np.uint8)
    if whole.shape[1:] == WHOLE:
        return np.stack([preprocessing.picture(each) for each in whole])
    return whole + np.uint8(1) if minus_one else whole  # wraps as WME's own sum does: its 254 is white, its 255 black
