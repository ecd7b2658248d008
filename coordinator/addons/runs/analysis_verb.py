"""`dreamfleet runs plot|receipt`: what runs reached, drawn, and as a paper cites it."""

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from dreamfleet.common.addons.analysis.learning import world_of
from dreamfleet.common.cli.command_line import SimpleVerb
from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path, open_output
from dreamfleet.common.printable import printable_lines
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.coordinator.addons.runs.citation import citation_facts, format_markdown

MOST_IN_NAME = 3  # runs that name a picture


def _add_place_flags(parser: argparse.ArgumentParser) -> None:
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def configure_plot(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `runs plot`."""
    parser.add_argument("run_names", metavar="RUN", nargs="+", help="names of runs")
    parser.add_argument(
        "--kind", choices=("fitness", "learning", "archive"),
        help="fitness: over generations; learning: evaluated scores over steps and core-hours; archive: the "
        "elites of cma-me and map-elites (default fitness of one run, learning of several)",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=Path, help="a PNG or SVG to write (default RUN-KIND.png, with the names of the runs)"
    )
    _add_place_flags(parser)


def plot_runs(args: argparse.Namespace) -> int:
    """Draw, and print the picture's path."""
    from dreamfleet.coordinator.addons.runs.plot import KINDS, draw_runs, save_figure

    kind = args.kind or ("fitness" if len(args.run_names) == 1 else "learning")
    out = args.out or _picture_name(args.run_names, kind)
    if out.suffix not in KINDS:
        raise UsageError(f"--out {out}: give a name that ends in {' or '.join(KINDS)}")
    check_output_path(out)
    with ExitStack() as stack:
        runs = [stack.enter_context(open_run(args.runs_dir, name)) for name in dict.fromkeys(args.run_names)]
        for each in runs:
            stack.enter_context(each.verified_transaction())
        if kind == "learning" and len(worlds := sorted({world_of(each) for each in runs})) > 1:
            note = f"these runs are in different worlds ({', '.join(worlds)}): their scores do not compare"
            print(f"note: {note}", file=sys.stderr)
        save_figure(draw_runs(runs, kind), out)
    print_answer(args, str(out), picture=out, runs=args.run_names)
    return 0


def _picture_name(runs: Sequence[str], what: str) -> Path:
    """A picture's name by its runs, so that one replaces no other's: a-learning.png, a-b-c-and-2-learning.png."""
    names = list(dict.fromkeys(runs))
    more = [f"and-{len(names) - MOST_IN_NAME}"] if len(names) > MOST_IN_NAME else []
    return Path("-".join((*names[:MOST_IN_NAME], *more, f"{what}.png")))


def configure_receipt(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `runs receipt`."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    parser.add_argument("--out", type=Path, help="write it there instead of printing it")
    _add_place_flags(parser)


def write_receipt(args: argparse.Namespace) -> int:
    """Print or write what a paper cites of a run, as Markdown or as JSON."""
    if args.out is not None:
        check_output_path(args.out)
    with open_run(args.runs_dir, args.run_name) as stored, stored.verified_transaction():
        text = (
            json.dumps(citation_facts(stored), default=str) if args.json else printable_lines(format_markdown(stored))
        )
    if args.out is None:
        print(text)
        return 0
    with open_output(args.out) as file:
        file.write(f"{text}\n".encode())
    print(args.out)
    return 0


PLOT = SimpleVerb(
    "draw one run's fitness over generations, or runs' evaluated scores over environment steps and core-hours",
    configure_plot,
    plot_runs,
    EXTRAS=("views",),
)
RECEIPT = SimpleVerb(
    "print what a paper cites of a run: seeds, hashes, versions, fingerprint, score, and the commands that check it",
    configure_receipt,
    write_receipt,
)
