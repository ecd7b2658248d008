"""Format measured figures as rows of a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

from dreamfleet.common.printable import plural
from dreamfleet.worker.addons.inspection.likeness import LikenessReport
from dreamfleet.worker.addons.inspection.measure import FigureReport
from dreamfleet.worker.addons.inspection.probe import Estimate, Knowledge
from dreamfleet.worker.addons.inspection.road_losses import CALM, LossReport
from dreamfleet.worker.addons.inspection.survival import Survival

Rows = Sequence[Mapping[str, object]]
NAMES = ("quantity", "begun", "mean", "policy")  # columns of words
BEGUN = {"0 steps before": "at the loss", CALM: "where nothing is lost"}  # clearer words for some beginnings
HELD = {"z": "z", "zh": "[z, h]"}
WHERE = {
    "reality": "reality",
    "foreseen": "reality, foreseen",
    "dream": "dream",
    "same_actions": "dream, reality's actions",
}
WHAT = {"lost": "road lost", "off_at_end": "off at the end", "offset_at_end": "offset at the end", "reward": "reward"}


def table_of(found: FigureReport) -> tuple[Rows, tuple[str, ...], str]:
    """A figure as rows, the columns of them that are right-aligned, and a text that describes them."""
    if isinstance(found, LossReport):
        rows, text = _losses(found)
    elif isinstance(found, Survival):
        rows, text = _survival(found)
    elif isinstance(found, LikenessReport):
        rows, text = _likeness(found)
    else:
        rows, text = _knowledge(found)
    return rows, tuple(name for name in rows[0] if name not in NAMES), text


def _knowledge(found: Knowledge) -> tuple[Rows, str]:
    rows = [
        {"quantity": each.quantity, "deviation": f"{each.deviation:.3g}"}
        | {_column(name): str(share) for name, share in each.found.items()}
        for each in found.known
    ]
    return rows, (
        f"R² ± standard error on held-out drives; {plural(found.drives, 'drive')}, {plural(found.steps, 'step')}, none "
        "off a road; deviations in the units of the world's true state (docs/reference/tasks.md)"
    )


def _losses(found: LossReport) -> tuple[Rows, str]:
    rows = [
        {"begun": BEGUN.get(each.begun, each.begun), "n": each.count, "mean": WHAT[figure]}
        | {WHERE[where]: str(estimate) for where, estimate in by_source.items()}
        for each in found.begun
        for figure, by_source in each.figures.items()
    ]
    return rows, (
        f"means ± standard errors over n beginnings in {plural(found.drives, 'drive')}, "
        f"{plural(found.dreams, 'dream')} of each. The road is lost "
        f"after {plural(found.lasting, 'step')} in a row off it, and the end is as long"
    )


def _likeness(found: LikenessReport) -> tuple[Rows, str]:
    rows = [
        {"quantity": each.quantity, "rare": f"above {each.rare:.3g}"}
        | {WHERE[where]: str(share) for where, share in each.found.items()}
        for each in found.quantities
    ]
    return rows, (
        "shares of steps ± standard errors over drives: at these a quantity is larger than at nine of ten real steps. "
        "Measured by the truth, and by a linear probe on [z, h]. Dreams begin after each drive's opening and last as "
        "long"
    )


def _survival(found: Survival) -> tuple[Rows, str]:
    rows = [
        {
            "policy": each.policy,
            "reality": str(each.real),
            "dream": str(each.dreamt),
            "dream / reality": str(each.ratio),
            "cut, reality": f"{each.real_cut:.0%}",
            "cut, dream": f"{each.dreamt_cut:.0%}",
        }
        for each in found.policies
    ]
    return rows, (
        f"mean steps ± standard error of {found.episodes} real and {found.episodes} dreamt episodes each, cut at "
        f"{found.limit}; temperature {found.temperature:g}, end {found.end}; agreement {found.agreement} (0: equally "
        "long everywhere, -0.69: twice or half as long)"
    )


def measured_rows(measured: Any) -> Iterator[tuple[str, str]]:
    """Yield a row for each main figure in a manifest's `measured`; malformed entries are left out."""
    with suppress(KeyError, TypeError, ValueError, AttributeError, OverflowError):
        for each in measured.get("probe", {}).get("known", ()):
            yield f"R² of {each['quantity']}, linear on [z, h]", _estimate(each["found"]["zh_linear"])
        for each in measured.get("losses", {}).get("begun", ()):
            yield f"road lost in dreams begun {each['begun']}", _estimate(each["figures"]["lost"]["dream"])
        for each in measured.get("survival", {}).get("policies", ()):
            yield f"lives in dreams, of its real life: {each['policy']}", _estimate(each["ratio"])
        for each in measured.get("likeness", {}).get("quantities", ()):
            yield f"dreamt share of {each['quantity']} above {each['rare']:.3g}", _estimate(each["found"]["dream"])


def _estimate(figure: dict[str, Any]) -> str:
    return str(Estimate(figure["value"], figure["error"]))


def _column(name: str) -> str:
    held, how = name.split("_")
    return f"{HELD[held]}, {how}"
