"""`dreamfleet compare`: runs or evaluation reports beside each other; the settings of sweeps."""

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from dreamfleet.common.addons.analysis.comparison import (
    CORE_HOURS,
    ComparedRun,
    EqualBudget,
    EvaluatedMean,
    are_comparable,
    at_equal_budget,
    budget_name,
    difference,
    differing_settings,
    differing_values,
    paired_scores,
)
from dreamfleet.common.addons.evaluation_report import EvaluationReport, read_evaluation_report
from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_rows
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.regular_files import is_file
from dreamfleet.common.printable import format_number, format_setting, plural
from dreamfleet.common.protocol.function_values import value_of
from dreamfleet.common.protocol.tasks import is_function_task
from dreamfleet.common.runs.paired_difference import PairedDifference
from dreamfleet.common.runs.records import count_episodes, format_mean, with_error
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.common.worlds.score_words import score_word
from dreamfleet.experiments.sweep import summary
from dreamfleet.experiments.sweep.folder import find_sweep
from dreamfleet.experiments.verbs.sweep import print_settings

SUMMARY = (
    "compare runs (settings that differ, scores at equal steps and core-hours, confirmed scores), reports of "
    "`evaluate --out` (paired differences), or the settings of sweeps"
)
EXTRAS = ()
#: fields of reports that may cause a difference besides the controllers, and their plurals
OTHER_CAUSES = {"world": "worlds", "judge": "judges", "options": "options", "fingerprint": "fingerprints"}
SAME_SEEDS = "all runs have the same validation seeds, so their ± are not independent: differences are paired"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "names", metavar="RUN|SWEEP|REPORT", nargs="+",
        help="names of runs, or files of `evaluate --out`, 2 or more; or names of sweeps, with runs beside them",
    )  # fmt: skip
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Compare files as reports and other names as runs or sweeps, and note which of them it was."""
    if any(find_sweep(args.runs_dir, name) for name in args.names):
        return _compare_sweeps(args, list(dict.fromkeys(args.names)))
    files = [name for name in args.names if is_file(Path(name))]
    if len(args.names) < 2:
        raise UsageError("give two runs or more, or two reports or more: each is compared with the first")
    if files and len(files) < len(args.names):
        other = next(name for name in args.names if name not in files)
        raise UsageError(
            f"{files[0]} is a file and {other} is none: compare runs with runs, or reports with reports; "
            "`dreamfleet evaluate --controller RUN --out FILE` makes a report of a run"
        )
    if not args.json:
        print(f"comparing {'reports of `evaluate`' if files else 'runs on this disk'}", file=sys.stderr)
    if files:
        return _compare_reports(args, [Path(name) for name in args.names])
    return _compare_runs(args, list(dict.fromkeys(args.names)))


def _compare_sweeps(args: argparse.Namespace, names: Sequence[str]) -> int:
    """Print the mean of each setting over its seeds; a run beside a sweep is a setting of its own."""
    results: list[summary.RunResult] = []
    for name in names:
        folder = find_sweep(args.runs_dir, name)
        if folder is None:
            results.append(summary.read_result(args.runs_dir, name, name))
            continue
        found = summary.read_results(args.runs_dir, folder.read().sweep.runs)
        results += found if len(names) == 1 else [replace(each, setting=f"{name}: {each.setting}") for each in found]
    if args.json:
        runs = [{"run": each.name, "setting": each.setting, "ended": each.ended, "scores": each.scores}
                for each in results]  # fmt: skip
        print(json.dumps({**summary.compare_settings(results), "runs": runs}))
        return 0
    if len(tasks := sorted({each.task.task for each in results if each.task is not None})) > 1:
        print(f"note: these are of different tasks ({', '.join(tasks)}): their scores do not compare", file=sys.stderr)
    print_settings(results)
    if open_ones := sum(not each.ended for each in results):
        print(f"{open_ones} of {plural(len(results), 'run')} not ended, and left out", file=sys.stderr)
    return 0


def _compare_reports(args: argparse.Namespace, paths: Sequence[Path]) -> int:
    """Print each mean, and its difference from the first on equal seeds if both are of one world and direction."""
    (first, base), *others = [(path, read_evaluation_report(path)) for path in paths]
    lines, rows = [_line(first, base)], []
    for path, each in others:
        causes = _other_causes(base, each)
        for what, values in causes.items():
            print(f"note: {first} and {path} are of different {OTHER_CAUSES[what]}: {values}", file=sys.stderr)
        figures: dict[str, Any] = {}
        if base.world != each.world:
            text = "scores of different worlds are not compared"
        elif base.results.minimised != each.results.minimised:
            text = "one is minimised and another is not: their values are not compared"
        else:
            found = PairedDifference.between(base.results, each.results)
            text = found.describe(minimised=base.results.minimised)
            figures = {**asdict(found), "clear": found.is_significant}
        lines += [_line(path, each), f"{path} less {first}: {text}"]
        rows.append({"report": path, "against": first, **figures, "differing_facts": list(causes)})
    print_answer(args, "\n".join(lines), differences=rows)
    return 0


def _other_causes(base: EvaluationReport, other: EvaluationReport) -> dict[str, str]:
    """The fields of two reports that may cause a difference besides the controllers, and their values as a text."""
    found = {}
    for what in OTHER_CAUSES:
        one, two = getattr(base, what), getattr(other, what)
        if what == "options":
            rows = differing_values([{"task": {"options": each}} for each in (one, two)])
            if rows:
                found[what] = ", ".join(
                    f"{name.removeprefix('task.options.')} {_shown(values[0])} and {_shown(values[1])}"
                    for name, values in rows.items()
                )
        elif one != two:
            found[what] = f"{one!r} and {two!r}"
    return found


def _shown(value: object) -> str:
    return "default" if value is None else format_setting(value)


def _line(path: Path, found: EvaluationReport) -> str:
    score = format_with_error(found.results.shown(found.results.mean), found.results.error)
    failed = f", and {len(found.failed)} failed" if found.failed else ""
    return f"{path}: {found.name}, {score} on {plural(len(found.drives), score_word(found.world))}{failed}"


def _compare_runs(args: argparse.Namespace, names: Sequence[str]) -> int:
    """Print settings that differ, scores at equal budgets, and differences from the first run."""
    if len(names) < 2:
        raise UsageError(f"{names[0]} is one run: give another to compare it with")
    sides = []
    for name in names:
        with open_run(args.runs_dir, name) as stored:
            sides.append(ComparedRun.of(stored))
    settings, worlds = differing_settings(sides), {each.world for each in sides if each.world is not None}
    comparable = are_comparable(sides)
    equal = at_equal_budget(sides) if comparable else []
    found = list(_run_differences(sides, equal)) if comparable else []
    if args.json:
        runs = [_run_facts(each) for each in sides]
        budgets = [{"what": each.what, "spent": each.spent, "looks": _evaluation_facts(sides, each)} for each in equal]
        print(json.dumps({"runs": runs, "settings": settings, "equal": budgets, "differences": found}, default=str))
        return 0
    shown = [each.in_values for each in sides]
    print_rows([_run_row(each) for each in shown], drop_order=("task", "spent"))
    print()
    if settings:
        rows = [[name, *map(_shown, values)] for name, values in settings.items()]
        print_rows([dict(zip(("setting", *(each.name for each in sides)), row, strict=True)) for row in rows])
        print()
    else:
        print("their settings are equal")
    if len(worlds) > 1:
        print(f"their evaluations are in different worlds ({', '.join(sorted(worlds))}): scores are not compared")
    elif sides and not comparable and worlds:
        print("one is minimised and another is not: their values are not compared")
    for each in at_equal_budget(shown) if comparable else []:
        print(_format_budget(sides, each))
    if found:
        print(f"\n{SAME_SEEDS}" if any("seeds" in each for each in found) else "")
        print("\n".join(f"{each['of']}: {each['run']} less {each['against']}: {each['text']}" for each in found))
    return 0


def _run_row(side: ComparedRun) -> dict[str, object]:
    word = score_word(side.world or "")
    confirmed, last = side.confirmed, side.evaluated_means[-1].point if side.evaluated_means else None
    return {
        "run": side.name,
        "task": side.settings.task.task,
        "spent": side.spent,
        "last evaluation": None if last is None else format_with_error(last.score, last.error),
        "confirmed": None if confirmed is None else f"{format_mean(confirmed)} on {count_episodes(confirmed, word)}",
    }  # fmt: skip


def _format_budget(sides: Sequence[ComparedRun], equal: EqualBudget) -> str:
    spent = f"{equal.spent:.3g}" if equal.what == CORE_HOURS else f"{equal.spent:,.0f}"
    parts = [f"{side.name} {_format_evaluation(look)}" for side, look in zip(sides, equal.evaluated_means, strict=True)]
    return f"at {spent} {budget_name(sides, equal.what)}: {', '.join(parts)}"


def _format_evaluation(look: EvaluatedMean | None) -> str:
    if look is None:
        return "without an evaluation"
    return f"{format_with_error(look.point.score, look.point.error)} (generation {look.generation})"


def _run_differences(sides: Sequence[ComparedRun], equal: Sequence[EqualBudget]) -> Iterator[dict[str, Any]]:
    """Each run less the first: at equal budgets, then of confirmed scores."""
    for of, side, one, other in paired_scores(sides, equal):
        found = difference(one, other)
        if isinstance(found, PairedDifference):
            figures = {**asdict(found), "clear": found.is_significant}
            text = found.describe(minimised=side.minimised)
        else:
            figures, text = {}, _describe_one_call(side, one, other) or found
        yield {"of": of, "run": side.name, "against": sides[0].name, **figures, "text": text}


def _describe_one_call(side: ComparedRun, one: Mapping[int, float], other: Mapping[int, float]) -> str:
    """The difference of two values of a function without noise, which has one call; empty for anything else."""
    task = side.settings.task
    if not is_function_task(task.task) or not len(one) == len(other) == len(one.keys() | other.keys()) == 1:
        return ""
    (seed,) = one
    better = other[seed] - one[seed]
    return (
        f"{format_number(value_of(better, task), '+')} in one call each; one run a side shows no difference of settings"
    )


def _run_facts(side: ComparedRun) -> dict[str, Any]:
    effort, inherited = ({**asdict(each), "core_hours": each.core_hours} for each in (side.total, side.inherited))
    confirmed = side.confirmed and with_error(side.confirmed)
    return {"run": side.name, "world": side.world, "effort": effort, "inherited": inherited, "confirmed": confirmed}


def _evaluation_facts(sides: Sequence[ComparedRun], equal: EqualBudget) -> list[Any]:
    return [
        look and {"run": side.name, "generation": look.generation, "score": look.point.score, "error": look.point.error}
        for side, look in zip(sides, equal.evaluated_means, strict=True)
    ]
