"""Two stored runs compared for the page, by the functions of `dreamfleet compare`. `page/compare.js` shows them."""

from pathlib import Path
from typing import Any

from dreamfleet.common.addons.analysis import comparison
from dreamfleet.common.addons.analysis.comparison import ComparedRun
from dreamfleet.common.errors import BundleError
from dreamfleet.common.printable import format_setting, plural, printable
from dreamfleet.common.runs.effort import Effort
from dreamfleet.common.runs.paired_difference import PairedDifference
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.common.worlds.score_words import score_word_of_run

Sides = tuple[ComparedRun, ComparedRun]


def compare_runs(runs_dir: Path, one: str, other: str) -> dict[str, Any]:
    """The settings that differ, and the paired differences `other - one`; none if they are of several worlds.

    `problem` says why a run's scores are unknown, such as a world model that is gone.

    `JournalError` or `UsageError` if a run is missing or unreadable.
    """
    with open_run(runs_dir, one) as first, open_run(runs_dir, other) as second:
        (base, problem), (side, other_problem) = _side(first), _side(second)
        word = score_word_of_run(second.spec, second.bundle_path)
    sides = base, side
    worlds = {each.world for each in sides if each.world is not None}
    pairs = comparison.paired_scores(sides, comparison.at_equal_budget(sides))
    return {
        "problem": problem or other_problem,
        "worlds": sorted(map(printable, worlds)),
        "differences": [
            _difference(of, sides, comparison.difference(*scores), word)
            for of, _, *scores in (pairs if comparison.are_comparable(sides) else ())
        ],
        "settings": [
            [printable(name), *("default" if value is None else printable(format_setting(value)) for value in values)]
            for name, values in comparison.differing_settings(sides).items()
        ],
    }


def _side(run: RunFolder) -> tuple[ComparedRun, str]:
    """A run, and why its scores are unknown; empty if they are not."""
    try:
        return ComparedRun.of(run), ""
    except BundleError as error:
        return ComparedRun(run.name, run.settings, None, Effort(), Effort(), (), None, {}), printable(str(error))


def _difference(of: str, sides: Sides, found: PairedDifference | str, word: str) -> dict[str, Any]:
    """A difference with its texts: what it is of, its size and what follows from it."""
    if isinstance(found, str):
        return {"of": of, "verdict": f"no difference: fewer than 2 common {word}s"}
    sign = -1 if sides[1].minimised else 1  # of a minimised function, the page shows values
    return {
        "of": of,
        "mean": sign * found.mean,
        "better": found.mean > 0,
        "error": found.error,
        "half": found.critical_value * found.error,  # a significant difference is larger
        "size": format_with_error(sign * found.mean, found.error, sign="+"),
        "on": plural(found.seeds, f"common {word}"),
        "clear": found.is_significant,
        "verdict": _verdict(sides, found),
    }


def _verdict(sides: Sides, found: PairedDifference) -> str:
    if found.mean == found.error == 0:
        return "bit-identical scores"
    if not found.is_significant:
        return f"not significant: under {found.threshold_text}"
    return f"{printable(sides[found.mean > 0].name)} is better"
