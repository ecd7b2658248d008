"""Format measured figures as rows of a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

from dreamfleet.common.printable import plural
from dreamfleet.worker.addons.inspection.knowledge import Knowledge
from dreamfleet.worker.addons.inspection.likeness import LikenessReport, RareFrequency
from dreamfleet.worker.addons.inspection.measure import FigureReport
from dreamfleet.worker.addons.inspection.probe import Estimate
from dreamfleet.worker.addons.inspection.road_losses import CALM, LossReport, RoadLossComparison
from dreamfleet.worker.addons.inspection.survival import Survival

Rows = Sequence[Mapping[str, object]]
BEGUN = {"0 steps before": "at the loss", CALM: "where nothing is lost"}  # clearer words for some beginnings
HELD = {"z": "z", "zh": "[z, h]"}
WHERE = {
    "reality": "reality",
    "foreseen": "reality, foreseen",
    "dream": "dream",
    "same_actions": "dream, reality's actions",
}
WHAT = {"lost": "road lost", "off_at_end": "off at the end", "offset_at_end": "offset at the end", "reward": "reward"}


def knowledge_rows(knowledge: Knowledge) -> list[dict[str, str]]:
    """A row per quantity: its true standard deviation, and R² by inputs and kind of map."""
    return [
        {"quantity": each.quantity, "deviation": f"{each.deviation:.3g}"}
        | {_column(name): str(share) for name, share in each.found.items()}
        for each in knowledge.known
    ]


def knowledge_text(knowledge: Knowledge) -> str:
    """Describe the rows of `knowledge_rows`."""
    return (
        f"R² ± standard error on held-out drives; {plural(knowledge.drives, 'drive')}, "
        f"{plural(knowledge.steps, 'step')}, none off a road; "
        "deviations in the units of the world's true state (docs/reference/tasks.md)"
    )


def loss_rows(compared: Sequence[RoadLossComparison]) -> list[dict[str, object]]:
    """A row per kind of beginning and figure, with a column per source."""
    return [
        {"begun": BEGUN.get(each.begun, each.begun), "n": each.count, "mean": WHAT[figure]}
        | {WHERE[where]: str(estimate) for where, estimate in by_source.items()}
        for each in compared
        for figure, by_source in each.figures.items()
    ]


def likeness_rows(compared: Sequence[RareFrequency]) -> list[dict[str, str]]:
    """A row per quantity: its threshold, and how often reality and dreams exceed it."""
    return [
        {"quantity": each.quantity, "rare": f"above {each.rare:.3g}"}
        | {WHERE[where]: str(share) for where, share in each.found.items()}
        for each in compared
    ]


def survival_rows(found: Survival) -> list[dict[str, str]]:
    """A row per policy: how many steps it lives in reality and in dreams, and the dreamt share of the real ones."""
    return [
        {
            "policy": each.policy,
            "reality": str(each.real),
            "dream": str(each.dreamt),
            "dream / reality": str(each.ratio),
        }
        | {"cut, reality": f"{each.real_cut:.0%}", "cut, dream": f"{each.dreamt_cut:.0%}"}
        for each in found.policies
    ]


def survival_text(found: Survival) -> str:
    """Describe the rows of `survival_rows`."""
    return (
        f"mean steps ± standard error of {found.episodes} real and {found.episodes} dreamt episodes each, cut at "
        f"{found.limit}; temperature {found.temperature:g}, end {found.end}; agreement {found.agreement} (0: equally "
        "long everywhere, -0.69: twice or half as long)"
    )


LIKENESS = (
    "shares of steps ± standard errors over drives: at these a quantity is larger than at nine of ten real steps. "
    "Measured by the truth, and by a linear probe on [z, h]. Dreams begin after each drive's opening and last as long"
)


def loss_text(found: LossReport) -> str:
    """Describe the rows of `loss_rows`."""
    return (
        f"means ± standard errors over n beginnings in {plural(found.drives, 'drive')}, "
        f"{plural(found.dreams, 'dream')} of each. The road is lost "
        f"after {plural(found.lasting, 'step')} in a row off it, and the end is as long"
    )


def table_of(found: FigureReport) -> tuple[Rows, tuple[str, ...], str]:
    """A figure as rows, the columns of them that are right-aligned, and a text that describes them."""
    if isinstance(found, LossReport):
        rows: Rows = loss_rows(found.begun)
        return rows, ("n", *tuple(rows[0])[3:]), loss_text(found)
    if isinstance(found, Survival):
        rows, text = survival_rows(found), survival_text(found)
    elif isinstance(found, LikenessReport):
        rows, text = likeness_rows(found.quantities), LIKENESS
    else:
        rows, text = knowledge_rows(found), knowledge_text(found)
    return rows, tuple(rows[0])[1:], text


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
