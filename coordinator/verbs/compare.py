"""`dreamfleet compare`: runs or evaluation reports beside each other, each against the first."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_rows
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.regular_files import is_file
from dreamfleet.common.printable import format_setting, plural
from dreamfleet.common.runs.evaluation_report import EvaluationReport, read_evaluation_report
from dreamfleet.common.runs.paired_difference import PairedDifference
from dreamfleet.common.runs.records import count_episodes, format_mean, with_error
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.common.worlds.score_words import score_word

if TYPE_CHECKING:
    from dreamfleet.common.runs.comparison import ComparedRun, EqualBudget, EvaluatedMean

SUMMARY = (
    "compare runs (settings that differ, scores at equal steps and core-hours, confirmed scores), or reports of "
    "`evaluate --out` (paired differences), each with the first"
)
EXTRAS = ()
SAME_SEEDS = (
    "all runs are judged on the same validation seeds, so their ± are not independent: differences are paired by seed"
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "names", metavar="RUN|REPORT", nargs="+", help="names of runs, or files of `evaluate --out`; 2 or more"
    )
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Compare files as reports and other names as runs, and note which of them it was."""
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


def _compare_reports(args: argparse.Namespace, paths: Sequence[Path]) -> int:
    """Print each mean, and its difference from the first on equal seeds."""
    (first, base), *others = [(path, read_evaluation_report(path)) for path in paths]
    lines, rows = [_line(first, base)], []
    for path, each in others:
        _warn(first, base, path, each)
        found = PairedDifference.between(base.results, each.results)
        lines += [_line(path, each), f"{path} less {first}: {found.description}"]
        rows.append({"report": path, "against": first, **asdict(found), "clear": found.is_significant})
    print_answer(args, "\n".join(lines), differences=rows)
    return 0


def _line(path: Path, found: EvaluationReport) -> str:
    score = format_with_error(found.results.mean, found.results.error)
    failed = f", and {len(found.failed)} failed" if found.failed else ""
    return f"{path}: {found.name}, {score} on {plural(len(found.drives), score_word(found.world))}{failed}"


def _warn(first: Path, base: EvaluationReport, path: Path, other: EvaluationReport) -> None:
    """Note what besides the controllers may cause a difference."""
    for what in ("world", "fingerprint"):
        one, another = getattr(base, what), getattr(other, what)
        if one != another:
            print(f"note: {first} and {path} are of different {what}s: {one!r} and {another!r}", file=sys.stderr)


def _compare_runs(args: argparse.Namespace, names: Sequence[str]) -> int:
    """Print settings that differ, scores at equal budgets, and differences from the first run."""
    from dreamfleet.common.runs.comparison import ComparedRun, at_equal_budget, differing_settings

    if len(names) < 2:
        raise UsageError(f"{names[0]} is one run: give another to compare it with")
    sides = []
    for name in names:
        with open_run(args.runs_dir, name) as stored:
            sides.append(ComparedRun.of(stored))
    settings, worlds = differing_settings(sides), {each.world for each in sides if each.world is not None}
    equal = at_equal_budget(sides) if len(worlds) == 1 else []
    found = list(_run_differences(sides, equal)) if len(worlds) == 1 else []
    if args.json:
        runs = [_run_facts(each) for each in sides]
        budgets = [_budget_facts(sides, each) for each in equal]
        print(json.dumps({"runs": runs, "settings": settings, "equal": budgets, "differences": found}, default=str))
        return 0
    print_rows([_run_row(each) for each in sides], drop_order=("task", "spent"))
    print()
    _print_settings(sides, settings)
    if len(worlds) > 1:
        print(f"their evaluations are in different worlds ({', '.join(sorted(worlds))}): scores are not compared")
    for each in equal:
        print(_format_budget(sides, each))
    if found:
        print(f"\n{SAME_SEEDS}")
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


def _print_settings(sides: Sequence[ComparedRun], settings: Mapping[str, Sequence[Any]]) -> None:
    if not settings:
        print("their settings are equal")
        return
    rows = [
        {
            "setting": name,
            **{
                side.name: "default" if value is None else format_setting(value)
                for side, value in zip(sides, values, strict=True)
            },
        }
        for name, values in settings.items()
    ]
    print_rows(rows)
    print()


def _format_budget(sides: Sequence[ComparedRun], equal: EqualBudget) -> str:
    spent = f"{equal.spent:,.0f}" if equal.what.startswith("steps") else f"{equal.spent:.3g}"
    parts = [f"{side.name} {_format_evaluation(look)}" for side, look in zip(sides, equal.evaluated_means, strict=True)]
    return f"at {spent} {equal.what}: {', '.join(parts)}"


def _format_evaluation(look: EvaluatedMean | None) -> str:
    if look is None:
        return "without an evaluation"
    return f"{format_with_error(look.point.score, look.point.error)} (generation {look.generation})"


def _run_differences(sides: Sequence[ComparedRun], equal: Sequence[EqualBudget]) -> Iterator[dict[str, Any]]:
    """Each run less the first: at equal budgets, then of confirmed scores."""
    from dreamfleet.common.runs.comparison import difference

    def paired(of: str, side: ComparedRun, one: dict[int, float], other: dict[int, float]) -> dict[str, Any]:
        found = difference(one, other)
        figures = {**asdict(found), "clear": found.is_significant} if isinstance(found, PairedDifference) else {}
        text = found.description if isinstance(found, PairedDifference) else found
        return {"of": of, "run": side.name, "against": sides[0].name, **figures, "text": text}

    for number, side in enumerate(sides[1:], 1):
        for each in equal:
            base, look = each.evaluated_means[0], each.evaluated_means[number]
            if base is not None and look is not None:
                yield paired(f"at equal {each.what}", side, base.scores, look.scores)
        if sides[0].confirmed is not None and side.confirmed is not None:
            yield paired("confirmed", side, sides[0].confirmed_scores, side.confirmed_scores)


def _run_facts(side: ComparedRun) -> dict[str, Any]:
    confirmed = side.confirmed and with_error(side.confirmed)
    effort = {**asdict(side.total), "core_hours": side.total.core_hours}
    inherited = {**asdict(side.inherited), "core_hours": side.inherited.core_hours}
    facts = {"run": side.name, "world": side.world, "effort": effort, "inherited": inherited}
    return {**facts, "confirmed": confirmed}


def _budget_facts(sides: Sequence[ComparedRun], equal: EqualBudget) -> dict[str, Any]:
    evaluated_means = [
        look and {"run": side.name, "generation": look.generation, "score": look.point.score, "error": look.point.error}
        for side, look in zip(sides, equal.evaluated_means, strict=True)
    ]
    return {"what": equal.what, "spent": equal.spent, "looks": evaluated_means}
