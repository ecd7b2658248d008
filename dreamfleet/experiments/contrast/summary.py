"""A contrast's results: one row per trial, means over seeds, differences between kinds. Pure."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from dreamfleet.common.printable import plural
from dreamfleet.common.runs.paired_difference import PairedDifference
from dreamfleet.common.runs.standard_error import format_with_error, standard_error

# Figures of held-out drives, as `train mdnrnn` names them; and the score in reality.
FIGURES = {
    "nats_per_dimension": "nats", "reward_loss": "reward loss", "reward_auc": "reward AUC",
    "reward_auc_after_10": "AUC after 10", "reward_auc_after_50": "after 50",
    "latent_error_after_10": "latent error after 10", "latent_error_after_50": "after 50 steps",
}  # fmt: skip
SCORE = "score"


@dataclass(frozen=True)
class TrialResult:
    """A trial's results: how well its model predicts held-out drives, and its controller's score in reality.

    `score` and `error` (standard error over `tracks`) are of the confirmed mean, else of the best evaluated one.
    """

    kind: str
    seed: int
    parameters: int
    quality: dict[str, float]
    score: float | None = None
    error: float | None = None
    tracks: int = 0
    confirmed: bool = False


@dataclass(frozen=True)
class SeedMean:
    """A figure of one kind over its seeds; `error` is the standard error, `None` of one seed."""

    kind: str
    figure: str
    seeds: int
    mean: float
    error: float | None

    @property
    def text(self) -> str:
        """In words."""
        digits = 1 if self.figure == SCORE else 3
        return format_with_error(self.mean, self.error, digits)


def rows(outcomes: Sequence[TrialResult]) -> list[dict[str, object]]:
    """One table row per trial."""
    return [
        {
            "kind": each.kind, "seed": each.seed, "parameters": f"{each.parameters:,}",
            **{label: each.quality.get(name) for name, label in FIGURES.items()},
            "reality": _reality(each),
        }
        for each in outcomes
    ]  # fmt: skip


def means(outcomes: Sequence[TrialResult]) -> list[SeedMean]:
    """Every figure of every kind over its seeds; the standard error is among seeds, not among tracks."""
    return [
        SeedMean(kind, figure, len(found), fmean(found), standard_error(found))
        for kind in _kinds(outcomes)
        for figure in (*FIGURES, SCORE)
        if (found := list(_by_seed(outcomes, kind, figure).values()))
    ]


def differences(outcomes: Sequence[TrialResult]) -> Iterator[tuple[str, str, PairedDifference]]:
    """Each kind less the first, paired by seed, if there are two seeds or more: kind, figure, difference."""
    first, *others = _kinds(outcomes)
    for kind in others:
        for figure in (*FIGURES, SCORE):
            one, other = (_by_seed(outcomes, each, figure) for each in (first, kind))
            if len(one.keys() & other.keys()) > 1:
                yield kind, figure, PairedDifference.of(one, other)


def describe_difference(kind: str, first: str, figure: str, found: PairedDifference) -> str:
    """A difference in words, and whether it is one."""
    digits = 1 if figure == SCORE else 3
    verdict = "" if found.is_significant else f": none, for one under {found.threshold_text} is none"
    size = format_with_error(found.mean, found.error, digits, sign="+")
    return f"{name_figure(figure)}: {kind} less {first} {size} over {plural(found.seeds, 'seed')}{verdict}"


def name_figure(figure: str) -> str:
    """A figure in words."""
    return "score in reality" if figure == SCORE else figure.replace("_", " ")


def _reality(found: TrialResult) -> str:
    if found.score is None:
        return "not evaluated"
    score = format_with_error(found.score, found.error)
    return f"{score} on {found.tracks}{'' if found.confirmed else ', provisional'}"


def _kinds(outcomes: Sequence[TrialResult]) -> list[str]:
    return list(dict.fromkeys(each.kind for each in outcomes))


def _by_seed(outcomes: Sequence[TrialResult], kind: str, figure: str) -> dict[int, float]:
    found: dict[int, Any] = {
        each.seed: each.score if figure == SCORE else each.quality.get(figure) for each in outcomes if each.kind == kind
    }
    return {seed: value for seed, value in found.items() if value is not None}
