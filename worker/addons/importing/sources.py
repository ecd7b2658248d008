"""What files or folders of other projects hold, by the names in them, and what is not read here; no data are read."""

import sys
from pathlib import Path

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.archives import ArchiveLimits, DamagedArchiveError, open_archive
from dreamfleet.common.files.regular_files import open_regular, path_exists

PLACES = {  # in a folder of hardmaru/WorldModelsExperiments
    "vae.json": ("vae.json", "vae/vae.json", "tf_models/vae.json"),
    "rnn.json": ("rnn.json", "rnn/rnn.json", "tf_models/rnn.json"),
    "initial_z.json": ("initial_z.json", "initial_z/initial_z.json", "tf_models/initial_z.json"),
}
CHECKPOINTS = ("best.tar", "checkpoint.tar")  # of ctallec/world-models; the second has the last epoch's weights
AGENT = "model.npz"  # of AttentionAgent
AGENT_ARRAY, AGENT_LIMITS = "params", ArchiveLimits(1 << 20, members=8)  # which has no other array
ANY_SIZE = ArchiveLimits(sys.maxsize)  # to read names alone
VAE, MDRNN, CONTROLLER = "vae", "mdrnn", "ctrl"  # the folders with these


def find_json(folder: Path, name: str) -> Path | None:
    """What has this name of WME's program, in a folder or where its program puts it."""
    return next((folder / place for place in PLACES[name] if path_exists(folder / place)), None)


def holds_json_model(folder: Path) -> bool:
    """Whether a folder looks like WME's: it has a VAE or an MDN-RNN as JSON."""
    return any(find_json(folder, name) is not None for name in ("vae.json", "rnn.json"))


def find_checkpoint(folder: Path, part: str) -> Path | None:
    """The checkpoint of `vae`, `mdrnn` or `ctrl` in a folder that ctallec's programs call `--logdir`."""
    return checkpoint_of(folder / part) if (folder / part).is_dir() else None


def holds_checkpoints(folder: Path) -> bool:
    """Whether a folder looks like ctallec's `--logdir`: it has the checkpoint of a VAE or an MDN-RNN."""
    return any(find_checkpoint(folder, part) is not None for part in (VAE, MDRNN))


def checkpoint_of(source: Path) -> Path | None:
    """The checkpoint that a path names: a `.tar`, or the one in a folder such as `ctrl`; `None` for other sources."""
    if source.is_dir():
        return next((source / name for name in CHECKPOINTS if path_exists(source / name)), None)
    return source if source.suffix.lower() == ".tar" else None


def find_attention_agent(source: Path) -> Path | None:
    """The weights of AttentionAgent that a path names: a file, or `model.npz` in a folder; `None` for other sources.

    What cannot be read is known by that name, unless other files could be drives beside it.
    """
    path = source / AGENT if source.is_dir() else source
    try:
        with open_regular(path) as file, open_archive(file, ANY_SIZE) as archive:
            return path if archive.names == {f"{AGENT_ARRAY}.npy"} else None
    except (OSError, DamagedArchiveError):
        return path if path.name == AGENT and drive_paths(source) == [path] else None


def drive_paths(source: Path) -> list[Path]:
    """The `.npz` files of a folder, or of the folders in it: ctallec's has one a process. A file is its only one."""
    if not source.is_dir():
        return [source]
    return sorted(source.glob("*.npz")) or sorted(source.glob("*/*.npz"))


REASONS = {
    ".h5": "Keras' weights have no reader here, and the article's controllers see a hidden state that knows the new "
    "picture, which no bundle has. Train a world model here on its drives (`dreamfleet import DRIVES --out DATA`)",
    ".pkl": "pickle executes code when it is read: save the numbers with `numpy.save`",
    ".pt": "it is not a checkpoint of a program that is known here: save the numbers with "
    "`numpy.save(FILE, tensor.numpy())`",
}
REASONS |= {".pickle": REASONS[".pkl"], ".pth": REASONS[".pt"]}
KERAS = ("vae/weights.h5", "rnn/weights.h5")  # of the article's program


def refuse_unreadable(source: Path) -> None:
    """`DatasetError` with the reason for a file, or folder of files, that cannot be read."""
    if source.is_dir() and any((source / each).is_file() for each in KERAS):
        raise DatasetError(f"{source} cannot be imported: {REASONS['.h5']}")
    if source.name in PLACES and not source.is_dir():
        raise DatasetError(f"{source} is a part of a world model: name its folder")
    reason = REASONS.get(source.suffix.lower())
    if reason is not None and source.is_file():
        raise DatasetError(f"{source} cannot be imported: {reason}")
