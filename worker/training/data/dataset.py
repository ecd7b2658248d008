"""The recorded episodes of a data set, and their world. They are streamed: memory holds a few dozen, never all."""

import json
import os
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.driving import FIRST_WORLD
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.files.archives import NPY, ArchiveLimits, Arrays, DamagedArchiveError, open_archive, parse_array
from dreamfleet.common.files.regular_files import open_regular, read_text
from dreamfleet.common.host.processes import shell_command
from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD, DataWorld
from dreamfleet.worker.tasks import registry
from dreamfleet.worker.tasks.recordable import Preprocessing, RecordableTask

BEGUN = "preset.json"  # what a data set was begun with
BEGUN_BYTES = 10_000
REMEDY = "choose another --data"
POOL_EPISODES = 48  # episodes whose frames are shuffled together (docs/explanation/sources.md)
POOL_FRAMES = 16_000  # most frames of a pool, unless one episode has more: 200 MB at 64x64, 440 MB at 96x96
VALIDATION_EVERY = 20  # every 20th episode is held out, whole
OWN_MEMBERS = frozenset(("action.npy", "reward.npy", "ended.npy"))  # of every episode
LIMITS = ArchiveLimits(512 << 20)  # bytes of an episode: 19,000 pictures at 96x96


@lru_cache(maxsize=16)
def find_world(name: str = FIRST_WORLD, options: str = "") -> RecordableTask:
    """Find the task `name` under these options, once; `UsageError` if it cannot be recorded.

    >>> find_world().world.score_word
    'track'
    """
    return registry.find_world(name, options)


def preprocessing_of_size(size: int, world: DataWorld = OF_FIRST_WORLD) -> Preprocessing:
    """The world's preprocessing with pictures of `size` pixels; `UsageError` if there is none."""
    known = find_world(*world).preprocessings.values()
    for each in known:
        if each.size == size:
            return each
    sizes = " or ".join(dict.fromkeys(str(each.size) for each in known))
    raise UsageError(f"pictures are {sizes} pixels wide, not {size}: give --picture {sizes}")


def preprocessing_of_drives(paths: Sequence[Path], size: int, world: DataWorld = OF_FIRST_WORLD) -> Preprocessing:
    """The preprocessing of the first drive, if its pictures have `size` pixels; else the world's of that size.

    Drives of other programs may have another one than those that are collected here.
    """
    found = find_world(*world).preprocessings.get(kind_of(paths[0])[1]) if paths else None
    return found if found is not None and found.size == size else preprocessing_of_size(size, world)


def load_begun(folder: Path) -> dict[str, Any]:
    """What a data set was begun with: `preset`, `seed`, `task` and its options, if any; empty if nothing is."""
    path = folder / BEGUN
    if not path.exists():
        return {}
    try:
        begun = json.loads(read_text(path, BEGUN_BYTES))
        if not all(isinstance(begun[name], str) for name in ("preset", "task", *({"options"} & set(begun)))):
            raise TypeError(f"it holds {begun!r:.100}")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(
            f"{path} names no preset and task ({error}); write those that collected the data into it"
        ) from error
    return dict(begun)


def find_own_world(folder: Path) -> DataWorld | None:
    """The world that a data set was begun in, or of its first drive; `None` for an empty folder."""
    if begun := load_begun(folder):
        return DataWorld(begun["task"], begun.get("options", ""))
    drives = (sorted((folder / kind).glob("[0-9]*.npz")) for kind in ("episodes", "encoded"))
    first = next((paths[0] for paths in drives if paths), None)
    if first is None:
        return None
    _check_own_file(first)
    return world_of_episode(first)


def world_of_folder(folder: Path) -> DataWorld:
    """The world of a data set; the first world for an empty folder."""
    return find_own_world(folder) or OF_FIRST_WORLD


def world_of_episode(path: Path) -> DataWorld:
    """The world that an episode, or an encoded one, was driven in."""
    return DataWorld.parse(str(load_arrays(path, "world")["world"]))


def episode_path(folder: Path, number: int) -> Path:
    """The path of an episode's file."""
    return folder / "episodes" / f"{number:06d}.npz"


def existing_episodes(folder: Path) -> list[Path]:
    """The paths of the recorded episodes, by number."""
    return sorted((folder / "episodes").glob("[0-9]*.npz"))


def episode_paths(folder: Path, kind: str = "episodes") -> list[Path]:
    """The paths of a data set's `episodes` or `encoded` episodes, by number; `DatasetError` for fewer than two."""
    paths = sorted((folder / kind).glob("[0-9]*.npz"))
    if len(paths) < 2:
        verb = "collect" if kind == "episodes" else "encode"
        others = (each for each in folder.glob("*/*.npz") if each.parent.name not in ("episodes", "encoded"))
        if not paths and (any(folder.glob("*.npz")) or any(others)):
            make = shell_command("import", folder, "--out", "DATA")
            raise DatasetError(f"{folder} holds drives of another program: `{make}` makes a data set")
        more = shell_command(verb, "--data", folder)
        raise DatasetError(f"{folder} holds {len(paths)} {kind}; at least 2 are needed: run `{more}`")
    return paths


def split_held_out(paths: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Split episodes into those to train on and those held out."""
    held_out = list(paths[::VALIDATION_EVERY])
    return [path for path in paths if path not in set(held_out)], held_out


def load_arrays(path: Path, *names: str, optional: Sequence[str] = ()) -> Arrays:
    """Load the named arrays of an episode, and the `optional` ones that it has.

    `DatasetError` if the file is damaged or lacks a named one.
    """
    try:
        with open_regular(path, LIMITS.size) as file, open_archive(file, LIMITS) as archive:
            wanted = (*names, *(name for name in optional if name + NPY in archive.names))
            return {name: parse_array(archive.read(name + NPY), name) for name in wanted}
    except (OSError, DamagedArchiveError) as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> DatasetError:
    return DatasetError(f"{path} is damaged ({error}); {_remedy(path)}")


def is_own_file(path: Path) -> bool:
    """Whether an archive is surely of this program: an episode, a controller or a subspace, by its members' names."""
    try:
        with open_regular(path, LIMITS.size) as file, open_archive(file, LIMITS) as archive:
            return archive.names >= OWN_MEMBERS or "about.npy" in archive.names
    except (OSError, DamagedArchiveError):
        return False


def _remedy(path: Path) -> str:
    if is_own_file(path):
        return "delete it, and run the verb that wrote it again"
    return "no verb of dreamfleet is known to have written it: choose another --data, or move it away"


def check_no_foreign_files(folder: Path) -> None:
    """`DatasetError` names the first archive in a data folder that is not surely of this program."""
    for place in (folder, folder / "episodes"):
        try:
            names = sorted(each.name for each in os.scandir(place) if each.name.endswith(".npz"))
        except FileNotFoundError:
            continue
        except OSError as error:
            raise DatasetError(f"{place} cannot be read ({error.strerror}): choose another --data") from error
        for name in names:
            if not name.startswith("."):
                _check_own_file(place / name)


def _check_own_file(path: Path) -> None:
    if not is_own_file(path):
        raise DatasetError(f"{path} is damaged, or of another program; {_remedy(path)}")


def check_whole(paths: Sequence[Path], *names: str) -> None:
    """`DatasetError` names the first episode that is damaged or lacks an array. It reads only archive directories."""
    for path in paths:
        try:
            with open_regular(path, LIMITS.size) as file, open_archive(file, LIMITS) as archive:
                missing = {f"{name}.npy" for name in names} - archive.names
        except (OSError, DamagedArchiveError) as error:
            raise _damaged(path, error) from error
        if missing:
            raise DatasetError(f"{path} lacks {', '.join(sorted(missing))}; {_remedy(path)}")


def check_pictures(
    paths: Sequence[Path], size: int, world: DataWorld | None = None, preprocessing: Preprocessing | None = None
) -> None:
    """`DatasetError` names the first episode of another world, or with other pictures than the first one's of `size`.

    The world and the preprocessing are those of the first episode, unless they are given.
    """
    kinds = {path: kind_of(path) for path in paths}
    world = world or next((own for own, _ in kinds.values()), OF_FIRST_WORLD)
    wanted = (preprocessing or preprocessing_of_drives(paths, size, world)).name
    for path, (own, found) in kinds.items():
        if own != world:
            raise DatasetError(f"{path} is of {own}, and the data are of {world}: a data set has one world; {REMEDY}")
        if found != wanted:
            raise DatasetError(
                f"{path} holds pictures {found!r}, and {wanted!r} are wanted: a data set and its VAE have one kind; "
                f"{REMEDY}, or --picture"
            )


def kind_of(path: Path) -> tuple[DataWorld, str]:
    """The world of an episode, and the name of the preprocessing of its pictures."""
    arrays = load_arrays(path, "preprocessing", "world")
    return DataWorld.parse(str(arrays["world"])), str(arrays["preprocessing"])


def load_pictures(path: Path) -> NDArray[np.uint8]:
    """Load an episode's pictures `(T, side, side, 3)`; `DatasetError` if they do not match its preprocessing."""
    arrays = load_arrays(path, "picture", "preprocessing", "world")
    pictures: NDArray[np.uint8] = arrays["picture"]
    world = DataWorld.parse(str(arrays["world"]))
    known = find_world(*world).preprocessings.get(str(arrays["preprocessing"]))
    fits = known is not None and pictures.ndim == 4 and pictures.shape[1:] == known.shape
    if not fits or not len(pictures) or pictures.dtype != np.uint8:
        raise DatasetError(f"{path} holds pictures of another preprocessing or shape; collect into an empty folder")
    return pictures


def load_steps(path: Path, *latents: str) -> Arrays:
    """Load `action` (T, actions), `reward` (T,), `ended` and the named `latents` (T, n) of an episode, as float32.

    `terminal` is whether it ended with a death; episodes without one end with a death if they ended. `DatasetError` if
    their types or lengths are wrong, or they are empty.
    """
    arrays = load_arrays(path, "action", "reward", "ended", *latents, optional=("terminal",))
    arrays.setdefault("terminal", arrays["ended"])
    steps = len(arrays["reward"]) if arrays["reward"].ndim else 0
    ranks = {"reward": 1, "action": 2, **dict.fromkeys(latents, 2)}
    fits = all(arrays[name].ndim == rank and len(arrays[name]) == steps for name, rank in ranks.items())
    flags = [arrays[name] for name in ("ended", "terminal")]
    if not (steps and fits and all(each.shape == () and each.dtype.kind in "bu" for each in flags)):
        raise _damaged(path, DatasetError("its arrays are not of one drive"))
    if not all(arrays[name].dtype.kind == "f" for name in ranks):
        raise _damaged(path, DatasetError("its actions, rewards or latents are not floats"))
    steps_of = {name: arrays[name].astype(np.float32, copy=False) for name in ranks}
    if not all(np.isfinite(each).all() for each in steps_of.values()):
        raise _damaged(path, DatasetError("its actions, rewards or latents hold NaN or infinity"))
    return {**arrays, **steps_of}


def picture_batches(
    paths: Sequence[Path], batch: int, seed: int, first_pool: int = 0, taken: int = 0
) -> Iterator[tuple[int, int, NDArray[np.uint8]]]:
    """Yield shuffled batches `(batch, side, side, 3)` without end, each with its pool and its number in the pool.

    A pure function of its arguments: pass a batch's two numbers to resume after it.
    """
    pool = first_pool
    while True:
        random = np.random.default_rng([seed, pool])
        chosen = random.choice(len(paths), size=min(POOL_EPISODES, len(paths)), replace=False)
        pictures = _load_pool([paths[index] for index in chosen])
        order = random.permutation(len(pictures))
        starts = range(0, max(len(order) - batch, 0) + 1, batch)
        for number, start in enumerate(starts[taken:], start=taken + 1):
            yield pool, number, pictures[order[start : start + batch]]
        pool, taken = pool + 1, 0


def _load_pool(paths: Sequence[Path]) -> NDArray[np.uint8]:
    loaded: list[NDArray[np.uint8]] = []
    frames = 0
    for path in paths:
        loaded.append(load_pictures(path))
        frames += len(loaded[-1])
        if frames >= POOL_FRAMES:
            break
    return np.concatenate(loaded)


def pad(sequences: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Stack sequences `(T_i, ...)` of unequal length to `(N, max T, ...)`, padded with zeros.

    `DatasetError` unless they agree in all but their length: NumPy would widen `(T, 1)` without a word.
    """
    if len(shapes := {each.shape[1:] for each in sequences}) > 1:
        found = " and ".join(map(str, sorted(shapes)))
        raise DatasetError(f"drives with steps of shapes {found} are not of one world or model; {REMEDY}")
    longest = max(len(sequence) for sequence in sequences)
    padded = np.zeros((len(sequences), longest, *sequences[0].shape[1:]), dtype=np.float32)
    for row, sequence in zip(padded, sequences, strict=True):
        row[: len(sequence)] = sequence
    return padded
