"""`dreamfleet runs list|show|archive|backup|delete|export`: the runs on this disk."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Collection, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.cli.add_ons import find_add_on
from dreamfleet.common.cli.command_line import SimpleVerb
from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_rows
from dreamfleet.common.client.elites import EliteArchive
from dreamfleet.common.client.equal_fitness import EqualFitness
from dreamfleet.common.client.eta import format_duration
from dreamfleet.common.errors import JournalError, UsageError
from dreamfleet.common.files.regular_files import is_folder, path_exists
from dreamfleet.common.printable import format_number, format_setting, plural
from dreamfleet.common.protocol.function_values import value_of
from dreamfleet.common.protocol.tasks import DREAM, is_function_task
from dreamfleet.common.runs.records import (
    RunSettings,
    StoredGeneration,
    best_evaluation,
    count_failed,
    describe_failed,
    describe_score,
    in_values,
    with_error,
)
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.common.runs.run_lock import run_lock
from dreamfleet.common.runs.run_paths import ARCHIVE as ARCHIVE_FOLDER
from dreamfleet.common.runs.run_paths import check_movable, reporting_folder_errors, resume_command, run_paths
from dreamfleet.common.runs.stages import begun_stages, describe_limit, describe_stages
from dreamfleet.common.transport.network import SECURED_PREFIX
from dreamfleet.common.worlds.score_words import score_word_of_run

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

DROP_ORDER = (
    "created",
    "classes",
    "sweep",
    "task",
    "mean",
    "evaluated",
)  # columns that a narrow terminal leaves out first
SCORES = ("mean", "evaluated", "confirmed")  # columns of `runs list`
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
    rows = [_run_row(path, in_text=not args.json) for path in run_paths(runs_dir)]
    find_sweeps = find_add_on("sweeps-of-runs")
    sweeps: Mapping[str, str] = find_sweeps(args.runs_dir) if find_sweeps else {}  # an archived run was begun there
    if args.json or any(row["run"] in sweeps for row in rows):
        rows = [{**row, "sweep": sweeps.get(row["run"])} for row in rows]
    if args.json:
        print(json.dumps(rows, indent=2))
        return 0
    if not rows:
        print(f"no runs in {runs_dir}; start one with: dreamfleet coordinator --run NAME", file=sys.stderr)
        return 0
    for row in rows:
        row |= {name: format_number(row[name]) for name in SCORES}
    print_rows(rows, right=("generations", *SCORES, "classes"), drop_order=DROP_ORDER)
    return 0


def _run_row(path: Path, *, in_text: bool) -> dict[str, Any]:
    """A run's row; `in_text` has a function's values, else its fitness."""
    try:
        with RunFolder(path) as run:
            history, evaluations, confirmed, spec = run.history(), run.evaluations(), run.confirmation(), run.spec
            found = {
                "mean": history[-1].mean if history and history[-1].number not in run.unscored_generations() else None,
                "evaluated": evaluations[-1].mean if evaluations else None,
                "confirmed": confirmed.mean if confirmed else None,
            }
            own = {name: value_of(score, spec) for name, score in found.items() if in_text and score is not None}
            return {
                "run": run.name,
                "created": run.created,
                "task": spec.task,
                "generations": len(history),
                **found,
                **own,
                "classes": run.classes.total,
                "state": run.state,
            }
    except JournalError as error:
        return {"run": path.name, "created": None, "task": None, "generations": None, "mean": None,
                "evaluated": None, "confirmed": None, "classes": None, "state": str(error)}  # fmt: skip


def show_run(args: argparse.Namespace) -> int:
    """Print a run's settings and generations; with `--json` also the settings that do not apply to it."""
    with open_run(args.runs_dir, args.run_name) as stored, stored.verified_transaction():
        settings, history, evaluations = stored.settings, stored.history(), stored.evaluations()
        confirmed, duration_seconds = stored.confirmation(), stored.duration_seconds
        facts = {
            "run": stored.name,
            "run_uid": stored.uid,
            "created": stored.created,
            "ended": stored.ended,
            "ended_at": stored.ended_at,
            "lasted_seconds": duration_seconds,
            "fingerprint": stored.fingerprint,
            "failed_candidates": count_failed(history),
            "replaced_seeds": (reseeds := stored.count_reseeds(history)),
            "equal_generations": (equal := EqualFitness(() if settings.is_external else history)).count,
        }
        unscored = stored.unscored_generations()
        best = best_evaluation(evaluations)
        stored_mean = None if best is None else stored.evaluated_mean(best.generation)
        checks = stored.checks
        classes, word = stored.classes, score_word_of_run(stored.spec, stored.bundle_path)
        limit = stored.episode_limit
        archive = EliteArchive.of(stored)
    begun = begun_stages(settings, history, evaluations) if settings.stages else ()
    if args.json:
        rows: dict[str, Any] = {"history": [_generation_facts(each, unscored) for each in history]}
        rows["evaluations"] = [with_error(each) for each in evaluations]
        rows["stages"] = [{"number": each.stage.number, "since": each.since, "after": each.why} for each in begun]
        reported = None if confirmed is None else with_error(confirmed)
        rows["classes"] = asdict(classes)
        rows |= {} if checks is None else {"checks": asdict(checks)}
        rows |= {} if archive is None else {"archive": archive.facts}
        print(json.dumps({**facts, "settings": asdict(settings), "confirmed": reported, **rows}, indent=2))
        return 0
    del facts["lasted_seconds"], facts["replaced_seeds"], facts["equal_generations"]
    facts |= {"warning": warning} if (warning := equal.describe(settings.task)) else {}
    if duration_seconds is not None:
        facts["ended_at"] = f"{facts['ended_at']}, {format_duration(duration_seconds)} after it began"
    facts["failed_candidates"] = describe_failed(settings, history, reseeds)
    facts["hosts"] = classes.description
    facts |= {f"class {name}": hosts for name, hosts in classes.rows}
    facts |= {} if checks is None else {"checks": checks.description}
    facts["reported"] = describe_score(in_values(confirmed or best_evaluation(evaluations), settings.task), word)
    if is_function_task(settings.task.task):
        facts |= _function_facts(stored_mean, settings.task.options)
    facts |= {} if archive is None else {"archive found": archive.description}
    facts |= {"stage": f"{begun[-1].stage.number} of {len(settings.stages)}"} if begun else {}
    shown_settings = {**_flatten_settings(settings), **describe_stages(settings, begun)}
    if source := describe_limit(settings.task.horizon, limit):
        shown_settings["task.horizon"] = f"{settings.task.horizon}; an episode has {limit} steps at most{source}"
    unused = _unused_settings(settings)
    shown_settings = {name: value for name, value in shown_settings.items() if value is not None and name not in unused}
    print_rows([{"": name, "value": value} for name, value in {**facts, **shown_settings}.items()])
    print()
    shown = history[-LAST_GENERATIONS:] if sys.stdout.isatty() else history
    judged = {each.generation: value_of(each.mean, settings.task) for each in evaluations}
    own = [in_values(each, settings.task) for each in shown]
    lines = [_generation_row(each, judged.get(each.number), scored=each.number not in unscored) for each in own]
    if len(shown) < len(history):
        print(f"the last {LAST_GENERATIONS} of {len(history)} generations; --json has all")
    least = ("seconds", "worst", "steps", "std", "sigma") + (
        () if any(each.failed for each in history) else ("failed",)
    )
    print_rows(lines, right=tuple(lines[0]) if lines else (), drop_order=least)
    return 0


def _function_facts(mean: NDArray[np.float32] | None, options: str) -> dict[str, str]:
    """The arguments of a function that the reported mean of its run stands for."""
    from dreamfleet.common.artifacts.objective import Objective

    objective = Objective.parse(options)
    values = f"the function's own; {'smaller' if objective.minimise else 'larger'} ones are better"
    found = "-" if mean is None else ", ".join(f"{each:z.8g}" for each in objective.decode(mean))
    return {"reported x": found, "values": values}


def _flatten_settings(settings: RunSettings) -> dict[str, object]:
    """Settings by name, with those of task and controller, without stages."""
    flat: dict[str, object] = {}
    plain = asdict(settings)
    del plain["stages"], plain["task"]["controller"]  # the same as the run's own
    for name, value in plain.items():
        flat |= {name: value} if not isinstance(value, dict) else _prefix_names(name, value)
    return {name: None if value in (None, "", ()) else format_setting(value) for name, value in flat.items()}


def _unused_settings(settings: RunSettings) -> set[str]:
    """Names of settings that change nothing in this run, by its task and by what it leaves out."""
    task = settings.task
    unused = {"task.version"} if task.version == 1 else set()
    if not task.bundle:
        unused |= {"features", "collect_every", "collect_episodes", "task.bundle"}
    if task.task != DREAM:
        unused |= {"driven", *(f"task.{name}" for name in ("temperature", "recorded", "driven", "end"))}
    if not settings.evaluate_every:
        unused |= {"evaluation_episodes", "confirm_episodes"}
    if not settings.collect_every:
        unused.add("collect_episodes")
    if settings.optimiser != "cma":
        unused.add("covariance")
    return unused


def _prefix_names(name: str, parts: dict[str, object]) -> dict[str, object]:
    return {part if part == name else f"{name}.{part}": value for part, value in parts.items() if value is not None}


def _generation_facts(each: StoredGeneration, unscored: Collection[int]) -> dict[str, Any]:
    missing = dict.fromkeys(("mean", "std", "best", "worst")) if each.number in unscored else {}
    return {**asdict(each), **missing}


def _generation_row(each: StoredGeneration, evaluated: float | None, *, scored: bool) -> dict[str, object]:
    fitness = {"mean": each.mean, "std": each.std, "best": each.best, "worst": each.worst}
    shown = {name: format_number(value if scored else None) for name, value in fitness.items()}
    return {
        "generation": each.number, **shown,
        "sigma": format_number(each.sigma), "failed": each.failed or "", "steps": each.steps,
        "seconds": f"{each.seconds:.1f}", "evaluated": "" if evaluated is None else format_number(evaluated),
    }  # fmt: skip


def archive_run(args: argparse.Namespace) -> int:
    """Move the run's folder into the archive."""
    open_run(args.runs_dir, args.run_name).close()
    source, target = args.runs_dir / args.run_name, args.runs_dir / ARCHIVE_FOLDER / args.run_name
    if target.exists():
        raise JournalError(f"{target} exists; rename it first")
    check_movable(source)
    with run_lock(source), reporting_folder_errors(source):
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
    from dreamfleet.coordinator.settings.resume_settings import stored_network
    from dreamfleet.coordinator.storage.backup import back_up
    from dreamfleet.coordinator.storage.kept_revocations import REVOKED

    target = args.to / args.run_name
    with open_run(args.runs_dir, args.run_name) as source:
        back_up(source, target)
    with open_run(args.to, args.run_name) as copy:
        generations, results = len(copy.history()), copy.result_count()
        network, has_revoked = stored_network(copy), copy.fact(REVOKED) is not None
    secured = any(each.startswith(SECURED_PREFIX) for each in (*network.get("listen", ()), *network.get("connect", ())))
    join = args.global_config.join or ("FILE" if secured else None)
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
    check_movable(folder)
    with run_lock(folder), reporting_folder_errors(folder):
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
    from dreamfleet.coordinator.views.export import export_csv, export_parquet, export_tensorboard

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
