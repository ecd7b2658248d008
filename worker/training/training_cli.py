"""Run a training from a verb: progress bar, end, figures."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path

from dreamfleet.common.cli.output import print_answer
from dreamfleet.common.cli.progress import progress_bar
from dreamfleet.common.errors import StoppedError
from dreamfleet.common.files.locks import folder_lock
from dreamfleet.common.host.stop_signals import Stop, stop_on_signals
from dreamfleet.worker.training.assemble import record_quality
from dreamfleet.worker.training.checkpoint import load_progress
from dreamfleet.worker.training.train_vae import ReportProgress
from dreamfleet.worker.training.training_state import resume_command


@dataclass(frozen=True)
class EarlyStop:
    """Patience ended after update `given_up_at`; the checkpoint is of `update`, which has the best held-out loss."""

    update: int
    held_out_loss: float
    given_up_at: int

    def __str__(self) -> str:
        return (
            f"ended early after update {self.given_up_at}, as --patience says: the checkpoint is that of update "
            f"{self.update}, the best on held-out drives (loss {self.held_out_loss:.4g}); --patience 0 continues"
        )


def find_early_stop(path: Path) -> EarlyStop | None:
    """How the training of this checkpoint ended early; None if it did not."""
    progress = load_progress(path)
    if progress.get("stopped") is None:
        return None
    return EarlyStop(progress["update"], progress["best"], progress.get("given_up_at", progress["update"]))


@contextmanager
def explain_interrupt(path: Path, new: bool) -> Iterator[None]:
    """On a second Ctrl-C, which ends a training within an update, report what its checkpoint keeps."""
    try:
        yield
    except KeyboardInterrupt as error:
        if not path.exists():
            raise
        raise StoppedError(
            f"interrupted: {path} keeps what was made up to update {load_progress(path)['update']}; "
            f"{resume_command(new)} continues from there"
        ) from error


TrainModel = Callable[[ReportProgress, Stop], dict[str, float]]


def run_training(args: argparse.Namespace, name: str, updates: int, checkpoint: Path, train: TrainModel) -> int:
    """Train, store the figures beside the data, and print them; the exit code.

    `UsageError` while another process trains the same model in the folder: each would overwrite the other's.
    """
    is_there = checkpoint.parent.is_dir()  # a folder without data is none to make
    with (
        folder_lock(checkpoint.with_suffix(".lock"), f"training of the {name}") if is_there else nullcontext(),
        progress_bar(name, updates, "updates") as bar,
        explain_interrupt(checkpoint, args.new),
        stop_on_signals() as stop,
    ):
        figures = train(bar.update, stop)
    record_quality(args.data, figures)
    early = find_early_stop(checkpoint)
    text = "  ".join(f"{name} {value}" for name, value in figures.items())
    answer = text if early is None else f"{early}\n{text}"
    print_answer(args, answer, **figures, ended_early=early and asdict(early))
    return 0
