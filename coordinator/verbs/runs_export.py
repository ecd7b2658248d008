"""`dreamfleet runs export`: a run's journal as tables for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import UsageError
from dreamfleet.common.runs.run_folder import open_run

SUMMARY = "write a run's generations, candidates, evaluations and confirmed score as CSV, Parquet or TensorBoard events"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    kinds = parser.add_mutually_exclusive_group(required=True)
    kinds.add_argument("--csv", dest="kind", action="store_const", const="csv", help="a CSV file a table")
    kinds.add_argument("--parquet", dest="kind", action="store_const", const="parquet", help="a Parquet file a table")
    kinds.add_argument("--tensorboard", dest="kind", action="store_const", const="tensorboard",
                       help="an event file with curves over generations")  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="folder to write in (default RUN-csv and the like)")
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Write, and print what was written."""
    from dreamfleet.coordinator.analysis.export import export_csv, export_parquet, export_tensorboard

    kinds = {"csv": export_csv, "parquet": export_parquet, "tensorboard": export_tensorboard}
    folder = args.out or Path(f"{args.run_name}-{args.kind}")
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {folder} is no folder: name one")
    with open_run(args.runs_dir, args.run_name) as stored, stored.read_transaction():
        written = kinds[args.kind](stored, folder)
    text = "\n".join(map(str, written)) if written else f"run {args.run_name} has no row yet: nothing was written"
    print_answer(args, text, run=args.run_name, files=written)
    return 0
