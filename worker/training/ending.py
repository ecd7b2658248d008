"""How a training ended: early, or in the midst of an update."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from dreamfleet.common.errors import StoppedError
from dreamfleet.worker.training.checkpoint import load_progress
from dreamfleet.worker.training.schedule import same_command


@dataclass(frozen=True)
class EarlyEnd:
    """Patience was over after update `given_up_at`: the checkpoint is that of `update`, whose held-out loss is best."""

    update: int
    held_out_loss: float
    given_up_at: int

    def __str__(self) -> str:
        return (
            f"ended early after update {self.given_up_at}, as --patience says: the checkpoint is that of update "
            f"{self.update}, the best on held-out drives with a loss of {self.held_out_loss:.4g}; --patience 0 goes on"
        )


def early_end(path: Path) -> EarlyEnd | None:
    """Whether and how the training of this checkpoint ended early."""
    progress = load_progress(path)
    if progress.get("stopped") is None:
        return None
    return EarlyEnd(progress["update"], progress["best"], progress.get("given_up_at", progress["update"]))


@contextmanager
def told_what_is_kept(path: Path, new: bool) -> Iterator[None]:
    """A second Ctrl-C, which ends a training in the midst of an update, says what its checkpoint keeps."""
    try:
        yield
    except KeyboardInterrupt as error:
        if not path.exists():
            raise
        raise StoppedError(
            f"interrupted: {path} keeps what was made up to update {load_progress(path)['update']}; "
            f"{same_command(new)} goes on from there"
        ) from error
