"""Files of other projects that cannot be read here, and why."""

from __future__ import annotations

from pathlib import Path

from dreamfleet.common.errors import DatasetError

REASONS = {
    ".h5": "Keras' weights have no reader here, and the article's controllers see a hidden state that knows the new "
    "picture, which no bundle has. Train a world model here on its drives (`dreamfleet import DRIVES --out DATA`)",
    ".pkl": "pickle executes code when it is read: save the numbers with `numpy.save`",
    ".pickle": "pickle executes code when it is read: save the numbers with `numpy.save`",
    ".pt": "it is not a checkpoint of a program that is known here: save the numbers with "
    "`numpy.save(FILE, tensor.numpy())`",
    ".pth": "it is not a checkpoint of a program that is known here: save the numbers with "
    "`numpy.save(FILE, tensor.numpy())`",
}
KERAS = ("vae/weights.h5", "rnn/weights.h5")  # of the article's program


def refuse_unreadable(source: Path) -> None:
    """`DatasetError` with the reason for a file, or folder of files, that cannot be read."""
    if source.is_dir() and any((source / each).is_file() for each in KERAS):
        raise DatasetError(f"{source} cannot be imported: {REASONS['.h5']}")
    reason = REASONS.get(source.suffix.lower())
    if reason is not None and source.is_file():
        raise DatasetError(f"{source} cannot be imported: {reason}")
