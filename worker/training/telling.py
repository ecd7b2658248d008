"""A training as a verb shows it: a bar while it works, how it ended, its figures."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from dreamfleet.common.listing import answer
from dreamfleet.common.progress import progress_bar
from dreamfleet.common.stopping import Stop, heeding_signals
from dreamfleet.worker.training.assemble import record_quality
from dreamfleet.worker.training.ending import early_end, told_what_is_kept
from dreamfleet.worker.training.train_vae import Report

Training = Callable[[Report, Stop], dict[str, float]]


def show(args: argparse.Namespace, name: str, updates: int, checkpoint: Path, train: Training) -> int:
    """Train, keep the figures beside the data, and answer; the exit code."""
    with (
        progress_bar(name, updates, "updates") as bar,
        told_what_is_kept(checkpoint, args.new),
        heeding_signals() as stop,
    ):
        figures = train(bar.move, stop)
    record_quality(args.data, figures)
    early = early_end(checkpoint)
    text = "  ".join(f"{name} {value}" for name, value in figures.items())
    told = text if early is None else f"{early}\n{text}"
    answer(args, told, **figures, ended_early=early and asdict(early))
    return 0
