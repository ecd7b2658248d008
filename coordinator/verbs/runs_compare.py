"""`dreamfleet runs compare`: runs beside each other, and whether one is better."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_rows
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import format_setting
from dreamfleet.common.runs.run_folder import open_run

if TYPE_CHECKING:
    from dreamfleet.coordinator.analysis.comparison import ComparedRun, EqualBudget, EvaluatedMean

SUMMARY = (
    "compare runs: settings that differ, scores at equal steps and core-hours, confirmed scores, each to the first"
)
EXTRAS = ()
SAME_SEEDS = (
    "all runs are judged on the same validation seeds, so their ± are not independent: differences are told seed by "
    "seed"
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_names", metavar="RUN", nargs="+", help="names of runs, 2 or more")
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Print what differs."""
    from dreamfleet.coordinator.analysis.comparison import ComparedRun, at_equal_budget, differing_settings

    names = list(dict.fromkeys(args.run_names))
    if len(names) < 2:
        raise UsageError("give two runs or more: each is compared with the first")
    sides = []
    for name in names:
        with open_run(args.runs_dir, name) as stored:
            sides.append(ComparedRun.of(stored))
    settings, worlds = differing_settings(sides), {each.world for each in sides if each.world is not None}
    equal = at_equal_budget(sides) if len(worlds) == 1 else []
    found = list(_differences(sides, equal)) if len(worlds) == 1 else []
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
        print("\n".join(f"{each['of']}: {each['run']} less {each['against']}: {each['told']}" for each in found))
    return 0


def _run_row(side: ComparedRun) -> dict[str, object]:
    confirmed, last = side.confirmed, side.evaluated_means[-1].point if side.evaluated_means else None
    return {
        "run": side.name,
        "task": side.settings.task.task,
        "spent": side.total.description,
        "last evaluation": None if last is None else f"{last.score:.1f} ± {last.error:.1f}",
        "confirmed": None if confirmed is None else f"{confirmed.mean:.1f} ± {confirmed.error:.1f} on "
        f"{confirmed.episodes} seeds",
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
    return f"{look.point.score:.1f} ± {look.point.error:.1f} (generation {look.generation})"


def _differences(sides: Sequence[ComparedRun], equal: Sequence[EqualBudget]) -> Iterator[dict[str, Any]]:
    """Of each run less the first, by its looks at equal spending and by its confirmed score."""
    from dreamfleet.common.runs.paired_difference import PairedDifference
    from dreamfleet.coordinator.analysis.comparison import difference

    def told(of: str, side: ComparedRun, one: dict[int, float], other: dict[int, float]) -> dict[str, Any]:
        found = difference(one, other)
        figures = {**asdict(found), "clear": found.is_significant} if isinstance(found, PairedDifference) else {}
        text = found.description if isinstance(found, PairedDifference) else found
        return {"of": of, "run": side.name, "against": sides[0].name, **figures, "told": text}

    for number, side in enumerate(sides[1:], 1):
        for each in equal:
            base, look = each.evaluated_means[0], each.evaluated_means[number]
            if base is not None and look is not None:
                yield told(f"at equal {each.what}", side, base.scores, look.scores)
        if sides[0].confirmed is not None and side.confirmed is not None:
            yield told("confirmed", side, sides[0].confirmed_scores, side.confirmed_scores)


def _run_facts(side: ComparedRun) -> dict[str, Any]:
    confirmed = side.confirmed and {**asdict(side.confirmed), "error": side.confirmed.error}
    effort = {**asdict(side.total), "core_hours": side.total.core_hours}
    return {"run": side.name, "world": side.world, "effort": effort, "confirmed": confirmed}


def _budget_facts(sides: Sequence[ComparedRun], equal: EqualBudget) -> dict[str, Any]:
    evaluated_means = [
        look and {"run": side.name, "generation": look.generation, "score": look.point.score, "error": look.point.error}
        for side, look in zip(sides, equal.evaluated_means, strict=True)
    ]
    return {"what": equal.what, "spent": equal.spent, "looks": evaluated_means}
