"""Figures as rows of a table for people."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

from dreamfleet.worker.inspection.knowledge import Knowledge
from dreamfleet.worker.inspection.likeness import RareFrequency
from dreamfleet.worker.inspection.road_losses import CALM, RoadLossComparison

BEGUN = {"0 steps before": "at the loss", CALM: "where nothing is lost"}  # where another word says it better
HELD = {"z": "z", "zh": "[z, h]"}
WHERE = {
    "reality": "reality",
    "foreseen": "reality, foreseen",
    "dream": "dream",
    "same_actions": "dream, reality's actions",
}
WHAT = {"lost": "road lost", "off_at_end": "off at the end", "offset_at_end": "offset at the end", "reward": "reward"}


def knowledge_rows(knowledge: Knowledge) -> list[dict[str, str]]:
    """A row a quantity: its true deviation, and R² by what was seen and how it was mapped."""
    return [
        {"quantity": each.quantity, "deviation": f"{each.deviation:.3g}"}
        | {_column(name): str(share) for name, share in each.found.items()}
        for each in knowledge.known
    ]


def knowledge_text(knowledge: Knowledge) -> str:
    """What the rows are of."""
    return (
        f"R² ± standard error on held-out drives; {knowledge.drives} drives, {knowledge.steps} steps on the road; "
        "deviations in the world's own units, of CarRacing metres, radians and seconds"
    )


def loss_rows(compared: Sequence[RoadLossComparison]) -> list[dict[str, object]]:
    """A row a kind of beginning and figure: of reality, and of the dreams."""
    return [
        {"begun": BEGUN.get(each.begun, each.begun), "n": each.count, "mean": WHAT[figure]}
        | {WHERE[where]: str(estimate) for where, estimate in told.items()}
        for each in compared
        for figure, told in each.figures.items()
    ]


def likeness_rows(compared: Sequence[RareFrequency]) -> list[dict[str, str]]:
    """A row a quantity: what is rare in reality, and how often it is exceeded there and in dreams."""
    return [
        {"quantity": each.quantity, "rare": f"above {each.rare:.3g}"}
        | {WHERE[where]: str(share) for where, share in each.found.items()}
        for each in compared
    ]


LIKENESS = (
    "shares of steps ± standard errors over drives at which a quantity is larger than at nine of ten real steps, by "
    "the truth, and by a linear probe on [z, h]; dreams begin behind each drive's opening and last as long"
)


def loss_text(drives: int, dreams: int, lasting: int) -> str:
    """What the rows are of."""
    return (
        f"means ± standard errors over n beginnings in {drives} drives, {dreams} dreams of each; the road is lost "
        f"after {lasting} steps in a row off it, and the end is as long"
    )


def measured_rows(told: Any) -> Iterator[tuple[str, str]]:
    """What a manifest keeps of these figures: linear maps from [z, h], and how dreams are and what they lose.

    Whatever else a manifest holds there tells nothing.
    """
    with suppress(KeyError, TypeError, ValueError, AttributeError, OverflowError):
        for each in told.get("probe", {}).get("known", ()):
            yield f"R² of {each['quantity']}, linear on [z, h]", _estimate(each["found"]["zh_linear"])
        for each in told.get("losses", {}).get("begun", ()):
            yield f"road lost in dreams begun {each['begun']}", _estimate(each["figures"]["lost"]["dream"])
        for each in told.get("likeness", {}).get("quantities", ()):
            yield f"dreamt share of {each['quantity']} above {each['rare']:.3g}", _estimate(each["found"]["dream"])


def _estimate(told: dict[str, float]) -> str:
    return f"{told['value']:.2f} ± {told['error']:.2f}"


def _column(name: str) -> str:
    held, how = name.split("_")
    return f"{HELD[held]}, {how}"
