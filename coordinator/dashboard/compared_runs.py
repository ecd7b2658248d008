"""Two stored runs compared for the page, by the functions of `dreamfleet runs compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dreamfleet.common.printable import format_setting, plural, printable
from dreamfleet.common.runs.paired_difference import PairedDifference
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.common.worlds.score_words import score_word_of_run
from dreamfleet.coordinator.analysis.comparison import (
    ComparedRun,
    at_equal_budget,
    differing_settings,
    paired_differences,
)


def compare_runs(runs_dir: Path, one: str, other: str) -> dict[str, Any]:
    """The settings that differ, and the paired differences `other - one`; none if they are of several worlds.

    `JournalError` or `UsageError` if a run is missing or unreadable.
    """
    with open_run(runs_dir, one) as first, open_run(runs_dir, other) as second:
        sides = ComparedRun.of(first), ComparedRun.of(second)
        word = score_word_of_run(second.spec, second.bundle_path)
    worlds = {each.world for each in sides if each.world is not None}
    equal = at_equal_budget(sides) if len(worlds) == 1 else []
    found = paired_differences(sides, equal) if len(worlds) == 1 else ()
    return {
        "worlds": sorted(map(printable, worlds)),
        "differences": [_difference(each, word) for each in found],
        "settings": [
            [printable(name), *("default" if value is None else printable(format_setting(value)) for value in values)]
            for name, values in differing_settings(sides).items()
        ],
    }


def _difference(found: dict[str, Any], word: str) -> dict[str, Any]:
    """A difference with its texts: what it is of, its size and what follows from it."""
    if "mean" not in found:
        return {"of": found["of"], "verdict": f"no difference: fewer than 2 common {word}s"}
    paired = PairedDifference(found["seeds"], found["mean"], found["error"])
    return {
        "of": found["of"],
        "mean": paired.mean,
        "error": paired.error,
        "half": paired.critical_value * paired.error,
        "size": format_with_error(paired.mean, paired.error, sign="+,"),
        "on": plural(paired.seeds, f"common {word}"),
        "clear": paired.is_significant,
        "verdict": _verdict(found, paired),
    }


def _verdict(found: dict[str, Any], paired: PairedDifference) -> str:
    if paired.mean == paired.error == 0:
        return "bit-identical scores"
    if not paired.is_significant:
        return f"not significant: under {paired.threshold_text}"
    return printable(f"{found['run' if paired.mean > 0 else 'against']} is better")
