"""`dreamfleet runs compare|plot|receipt`: what runs reached, side by side, drawn, and as a paper cites it."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.cli.command_line import SimpleVerb
from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_rows
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path, open_output
from dreamfleet.common.printable import format_setting, printable_lines
from dreamfleet.common.runs.records import count_episodes, format_mean, with_error
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.common.worlds.score_words import score_word

if TYPE_CHECKING:
    from dreamfleet.common.runs.comparison import ComparedRun, EqualBudget, EvaluatedMean

SAME_SEEDS = (
    "all runs are judged on the same validation seeds, so their ± are not independent: differences are paired by seed"
)
LEARNING, FITNESS = "learning.png", "fitness.png"


def _add_place_flags(parser: argparse.ArgumentParser) -> None:
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def configure_compare(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `runs compare`."""
    parser.add_argument("run_names", metavar="RUN", nargs="+", help="names of runs, 2 or more")
    _add_place_flags(parser)


def compare_runs(args: argparse.Namespace) -> int:
    """Print settings that differ, scores at equal budgets, and differences from the first run."""
    from dreamfleet.common.runs.comparison import ComparedRun, at_equal_budget, differing_settings

    names = list(dict.fromkeys(args.run_names))
    if len(names) < 2:
        raise UsageError("give two runs or more: each is compared with the first")
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
        print(f"their evaluations are of the worlds {', '.join(sorted(worlds))}: scores are not compared")
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
        "spent": side.total.description,
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
        return "had nothing evaluated"
    return f"{format_with_error(look.point.score, look.point.error)} (generation {look.generation})"


def _run_differences(sides: Sequence[ComparedRun], equal: Sequence[EqualBudget]) -> Iterator[dict[str, Any]]:
    """Each run less the first: at equal budgets, then of confirmed scores."""
    from dreamfleet.common.runs.comparison import difference
    from dreamfleet.common.runs.paired_difference import PairedDifference

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
    return {"run": side.name, "world": side.world, "effort": effort, "confirmed": confirmed}


def _budget_facts(sides: Sequence[ComparedRun], equal: EqualBudget) -> dict[str, Any]:
    evaluated_means = [
        look and {"run": side.name, "generation": look.generation, "score": look.point.score, "error": look.point.error}
        for side, look in zip(sides, equal.evaluated_means, strict=True)
    ]
    return {"what": equal.what, "spent": equal.spent, "looks": evaluated_means}


def configure_plot(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `runs plot`."""
    parser.add_argument("run_names", metavar="RUN", nargs="+", help="names of runs")
    parser.add_argument("--fitness", action="store_true", help="draw one run's fitness, even if it has evaluations")
    parser.add_argument("--out", type=Path, help=f"a PNG or SVG to write (default {LEARNING}, or {FITNESS})")
    _add_place_flags(parser)


def plot_runs(args: argparse.Namespace) -> int:
    """Draw, and print the picture's path."""
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
    """Whether one run is named and none of its means was evaluated, so only fitness can be drawn."""
    if len(args.run_names) > 1:
        return False
    with open_run(args.runs_dir, args.run_names[0]) as stored:
        return not stored.evaluations()


def _draw_fitness(args: argparse.Namespace, out: Path) -> None:
    from dreamfleet.coordinator.analysis.plot import plot_fitness

    if len(args.run_names) > 1:
        raise UsageError("--fitness is of one run: name one")
    with open_run(args.runs_dir, args.run_names[0]) as stored:
        plot_fitness(stored, out)


def _draw_learning(args: argparse.Namespace, out: Path) -> None:
    from dreamfleet.common.runs.learning import LearningCurve
    from dreamfleet.coordinator.analysis.plot import plot_learning, published_scores

    curves = []
    for name in dict.fromkeys(args.run_names):
        with open_run(args.runs_dir, name) as stored:
            curves.append(LearningCurve.of(stored))
    worlds = sorted({each.world for each in curves})
    if len(worlds) > 1:
        names = ", ".join(worlds)
        print(f"note: these runs are of the worlds {names}: their scores do not compare", file=sys.stderr)
    plot_learning(curves, published_scores(curves), out)


def configure_receipt(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `runs receipt`."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    parser.add_argument("--out", type=Path, help="write it there instead of printing it")
    _add_place_flags(parser)


def write_receipt(args: argparse.Namespace) -> int:
    """Print or write what a paper cites of a run, as Markdown or as JSON."""
    from dreamfleet.coordinator.analysis.citation import citation_facts, format_markdown

    if args.out is not None:
        check_output_path(args.out)
    with open_run(args.runs_dir, args.run_name) as stored, stored.read_transaction():
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


COMPARE = SimpleVerb(
    "compare runs: settings that differ, scores at equal steps and core-hours, confirmed scores, each to the first",
    configure_compare,
    compare_runs,
)
PLOT = SimpleVerb(
    "draw runs' evaluated scores over environment steps and core-hours; or one run's fitness over generations, which "
    "is the default while it has no evaluation",
    configure_plot,
    plot_runs,
    EXTRAS=("views",),
)
RECEIPT = SimpleVerb(
    "print what a paper cites of a run: seeds, hashes, versions, fingerprint, score, and the commands that check it",
    configure_receipt,
    write_receipt,
)
