"""`dreamfleet runs list|show|archive|backup|delete|export`: the runs on this disk."""

import argparse
import json
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dreamfleet.common.cli.command_line import SimpleVerb
from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_rows
from dreamfleet.common.errors import JournalError, UsageError
from dreamfleet.common.files.regular_files import is_folder, path_exists
from dreamfleet.common.host.add_ons import find_add_on
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.printable import format_number, plural
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_lock import run_lock
from dreamfleet.common.runs.run_paths import ARCHIVE as ARCHIVE_FOLDER
from dreamfleet.common.runs.run_paths import resume_command, run_paths
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.common.transport.network import SECURED_PREFIX
from dreamfleet.coordinator.addons.runs.backup import back_up
from dreamfleet.coordinator.addons.runs.export import export_csv, export_parquet, export_tensorboard
from dreamfleet.coordinator.addons.runs.run_details import (
    generation_rows,
    run_document,
    run_facts,
    run_row,
    setting_rows,
    unused_settings,
)
from dreamfleet.coordinator.settings.resume_settings import stored_network
from dreamfleet.coordinator.storage.kept_revocations import REVOKED

# Columns that a narrow terminal leaves out first.
DROP_ORDER = ("created", "classes", "sweep", "task", "average", "best")
LAST_GENERATIONS = 20


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of a verb about one run: its name, the folder of runs, `--json`."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def configure_list(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `runs list`."""
    add_global_flags(parser, "runs_dir")
    parser.add_argument("--archived", action="store_true", help="list the archived runs instead")
    add_json_flag(parser)


def list_runs(args: argparse.Namespace) -> int:
    """Print one row per run; a run whose journal is damaged has the error as its state."""
    if not is_folder(args.runs_dir) and ("runs_dir" in args.given or path_exists(args.runs_dir)):
        raise UsageError(f"--runs-dir {args.runs_dir} is not a folder: name the one that holds runs")
    runs_dir = args.runs_dir / ARCHIVE_FOLDER if args.archived else args.runs_dir
    rows = [run_row(path, as_values=not args.json) for path in run_paths(runs_dir)]
    find_sweeps = find_add_on("sweeps-of-runs")
    sweeps: Mapping[str, str] = find_sweeps(args.runs_dir) if find_sweeps else {}  # an archived run was begun there
    if args.json:
        print(json.dumps([{**row, "sweep": sweeps.get(row["run"])} for row in rows], indent=2))
        return 0
    if not rows:
        begin = shell_command("coordinator", "--run", "NAME", "--runs-dir", args.runs_dir)
        print(f"no runs in {runs_dir}; start one with: {begin}", file=sys.stderr)
        return 0
    shown = [_shown_row(row) for row in rows]
    if any(row["run"] in sweeps for row in rows):
        shown = [{**row, "sweep": sweeps.get(str(row["run"]))} for row in shown]
    print_rows(shown, right=("generations", "average", "best", "confirmed", "classes"), drop_order=DROP_ORDER)
    return 0


def _shown_row(row: Mapping[str, Any]) -> dict[str, object]:
    """A run's row for people: the last generation's average, the best evaluation and the confirmed score."""
    best, confirmed = (
        "-" if row[name] is None else format_with_error(row[name], row[f"{name}_error"])
        for name in ("best", "confirmed")
    )
    return {
        "run": row["run"], "created": row["created"], "task": row["task"], "generations": row["generations"],
        "average": format_number(row["mean"]), "best": best, "confirmed": confirmed, "classes": row["classes"],
        "state": row["state"],
    }  # fmt: skip


def show_run(args: argparse.Namespace) -> int:
    """Print a run's settings and generations; with `--json` also the settings that do not apply to it."""
    with open_run(args.runs_dir, args.run_name) as stored, stored.verified_transaction():
        if args.json:
            print(json.dumps(run_document(stored), indent=2))
            return 0
        facts, rows, settings, limit = run_facts(stored), generation_rows(stored), stored.settings, stored.episode_limit
    plain = asdict(settings)
    del plain["stages"], plain["task"]["controller"]  # they are among the facts, and the run's own
    unused = unused_settings(settings)
    facts |= {name: value for name, value, _ in setting_rows(settings, plain, limit) if name not in unused}
    print_rows([{"": name, "value": value} for name, value in facts.items()])
    print()
    shown = rows[-LAST_GENERATIONS:] if sys.stdout.isatty() else rows
    if len(shown) < len(rows):
        print(f"the last {LAST_GENERATIONS} of {len(rows)} generations; --json has all")
    least = () if any(each["failed"] for each in rows) else ("failed",)
    order = ("seconds", "worst", "steps", "std", "sigma", *least)
    print_rows(shown, right=tuple(rows[0]) if rows else (), drop_order=order)
    return 0


def archive_run(args: argparse.Namespace) -> int:
    """Move the run's folder into the archive."""
    open_run(args.runs_dir, args.run_name).close()
    source, target = args.runs_dir / args.run_name, args.runs_dir / ARCHIVE_FOLDER / args.run_name
    if target.exists():
        raise JournalError(f"{target} exists; rename it first")
    _check_movable(source)
    with run_lock(source), _reporting_folder_errors(source):
        target.parent.mkdir(exist_ok=True)
        source.rename(target)
    print_answer(args, f"archived as {target}; move it back to use it again", run=args.run_name, archived=target)
    return 0


def configure_backup(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `runs backup`."""
    parser.add_argument("--to", type=Path, required=True, help="the other folder of runs, best on another disk")
    add_run_arguments(parser)


def back_up_run(args: argparse.Namespace) -> int:
    """Copy a run and read the copy; the run may be served meanwhile."""
    target = args.to.absolute() / args.run_name  # the command is for later, perhaps in another folder
    with open_run(args.runs_dir, args.run_name) as source:
        back_up(source, target)
    with open_run(args.to, args.run_name) as copy:
        generations, results = len(copy.history()), copy.result_count()
        network, has_revoked = stored_network(copy), copy.fact(REVOKED) is not None
    secured = any(each.startswith(SECURED_PREFIX) for each in (*network.get("listen", ()), *network.get("connect", ())))
    join = named.absolute() if (named := args.global_config.join) else "FILE" if secured else None
    access_dir = Path("FOLDER") if has_revoked else None  # of the list of revoked files, which the copy needs
    text = (
        f"copied to {target}: {plural(generations, 'closed generation')}, {plural(results, 'result')}; should its own "
        f"folder be lost, continue with: {resume_command(target, join, access_dir)}"
    )
    print_answer(args, text, run=args.run_name, copy=target, generations=generations, results=results)
    return 0


def configure_delete(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `runs delete`."""
    add_run_arguments(parser)
    parser.add_argument("--yes", action="store_true", help="do not ask")


def delete_run(args: argparse.Namespace) -> int:
    """Delete a run's folder once confirmed; exit 1 if it is kept."""
    with open_run(args.runs_dir, args.run_name) as stored:
        generations = len(stored.history())
    if not args.yes:
        if not sys.stdin.isatty():
            raise UsageError("cannot ask for confirmation: no terminal; give --yes")
        answer = input(f"delete run {args.run_name} with its {plural(generations, 'generation')}? [y/N] ")
        if answer.strip().lower() not in ("y", "yes"):
            print_answer(args, "kept", run=args.run_name, deleted=None)
            return 1
    folder = args.runs_dir / args.run_name
    _check_movable(folder)
    with run_lock(folder), _reporting_folder_errors(folder):
        shutil.rmtree(folder)
    print_answer(args, f"deleted {folder}", run=args.run_name, deleted=folder)
    return 0


def configure_export(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `runs export`."""
    kinds = parser.add_mutually_exclusive_group(required=True)
    kinds.add_argument("--csv", dest="kind", action="store_const", const="csv", help="a CSV file a table")
    kinds.add_argument("--parquet", dest="kind", action="store_const", const="parquet", help="a Parquet file a table")
    kinds.add_argument("--tensorboard", dest="kind", action="store_const", const="tensorboard",
                       help="an event file with curves over generations")  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="folder to write in (default RUN-csv and the like)")
    add_run_arguments(parser)


def export_run(args: argparse.Namespace) -> int:
    """Write a run's journal as tables, and print the files' paths."""
    kinds = {"csv": export_csv, "parquet": export_parquet, "tensorboard": export_tensorboard}
    if args.run_name.endswith(f".{args.kind}"):
        command = f"dreamfleet runs export RUN --{args.kind} --out FOLDER"
        raise UsageError(f"{args.run_name} is a file's name: --{args.kind} takes none, so write {command}")
    folder = args.out or Path(f"{args.run_name}-{args.kind}")
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {folder} is not a folder: name one")
    with open_run(args.runs_dir, args.run_name) as stored, stored.verified_transaction():
        written = kinds[args.kind](stored, folder)
    text = "\n".join(map(str, written)) if written else f"run {args.run_name} has no row yet: nothing was written"
    print_answer(args, text, run=args.run_name, files=written)
    return 0


def _check_movable(folder: Path) -> None:
    """`JournalError` if a run's folder is a symbolic link or holds other runs: it must not be moved or deleted."""
    if folder.is_symlink():
        raise JournalError(f"{folder} is a link: move or delete what it leads to by hand")
    if inside := ", ".join(each.name for each in run_paths(folder)):
        raise JournalError(f"{folder} holds other runs ({inside}): move them away first")


@contextmanager
def _reporting_folder_errors(folder: Path) -> Iterator[None]:
    """Turn an `OSError` while moving or deleting a run's folder into a `JournalError`."""
    try:
        yield
    except OSError as error:
        raise JournalError(f"{folder} cannot be moved or deleted: {error.strerror or error}") from error


LIST = SimpleVerb("list the runs on this disk", configure_list, list_runs)
SHOW = SimpleVerb("show one run from its journal: settings, history, evaluations", add_run_arguments, show_run)
ARCHIVE = SimpleVerb("move a run that is not served into the archive", add_run_arguments, archive_run)
BACKUP = SimpleVerb(
    "copy a run, served or not, into another folder of runs, from which it can be resumed",
    configure_backup,
    back_up_run,
)
DELETE = SimpleVerb(
    "delete a run that is not served, with its journal, controller and videos", configure_delete, delete_run
)
EXPORT = SimpleVerb(
    "write a run's generations, candidates, evaluations and confirmed score as CSV, Parquet or TensorBoard events",
    configure_export,
    export_run,
)
