"""`dreamfleet runs plot`: what runs learnt, as a picture."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path
from dreamfleet.common.runs.run_folder import open_run

SUMMARY = (
    "draw runs' evaluated scores over environment steps and core-hours, or one run's fitness over generations, as is "
    "done of one that has no evaluated mean yet"
)
EXTRAS = ("views",)
NEAR_SHARE = 0.1  # of the first published mark's steps, from which on marks are drawn: shorter runs would be squeezed
LEARNING, FITNESS = "learning.png", "fitness.png"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_names", metavar="RUN", nargs="+", help="names of runs")
    parser.add_argument("--fitness", action="store_true", help="draw what one run's candidates scored, in any case")
    parser.add_argument("--out", type=Path, help=f"a PNG or SVG to write (default {LEARNING}, or {FITNESS})")
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Draw, and print where it lies."""
    from dreamfleet.coordinator.analysis.plot import KINDS

    fitness = args.fitness or _has_no_evaluation(args)
    out = args.out or Path(FITNESS if fitness else LEARNING)
    if out.suffix not in KINDS:
        raise UsageError(f"--out {out}: give a name that ends in {' or '.join(KINDS)}")
    check_output_path(out)
    (_draw_fitness if fitness else _draw_learning)(args, out)
    print_answer(args, str(out), picture=out, runs=args.run_names)
    return 0


def _has_no_evaluation(args: argparse.Namespace) -> bool:
    """Whether it is one run without any evaluated mean: then its fitness is all that there is."""
    if len(args.run_names) > 1:
        return False
    with open_run(args.runs_dir, args.run_names[0]) as stored:
        return not stored.evaluations()


def _draw_fitness(args: argparse.Namespace, out: Path) -> None:
    from dreamfleet.coordinator.analysis.plot import plot_fitness

    if len(args.run_names) > 1:
        raise UsageError("--fitness is of one run: name one")
    with open_run(args.runs_dir, args.run_names[0]) as stored:
        if not stored.history():
            raise UsageError(
                f"run {stored.name} has no closed generation, so there is nothing to draw: wait for the first"
            )
        plot_fitness(stored, out)


def _draw_learning(args: argparse.Namespace, out: Path) -> None:
    from dreamfleet.common.artifacts.car_racing_variants import CAR_RACING
    from dreamfleet.coordinator.analysis.learning import PAPER_SCORES, LearningCurve
    from dreamfleet.coordinator.analysis.plot import plot_learning

    curves = []
    for name in dict.fromkeys(args.run_names):
        with open_run(args.runs_dir, name) as stored:
            curves.append(LearningCurve.of(stored))
    worlds = sorted({each.world for each in curves})
    if len(worlds) > 1:
        worlds_told = ", ".join(worlds)
        print(f"note: these runs are of the worlds {worlds_told}: their heights do not compare", file=sys.stderr)
    near = max(each.total.steps for each in curves) >= NEAR_SHARE * PAPER_SCORES[0].steps
    plot_learning(curves, PAPER_SCORES if near and worlds == [CAR_RACING] else (), out)
