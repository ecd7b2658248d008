"""A new world model takes the old one's place unless it is clearly worse."""

import pytest

from dreamfleet.experiments.iteration.gate import KNOWS, LOSES, SURVIVES, Figure, figures, judge
from dreamfleet.worker.addons.inspection.dream_comparisons import LossReport, RoadLossComparison
from dreamfleet.worker.addons.inspection.probe import Estimate, Knowledge, KnownQuantity
from dreamfleet.worker.addons.inspection.survival import Survival


def both(knows=(0.8, 0.01), loses=(0.1, 0.02)):
    return {KNOWS: Figure(*knows), LOSES: loses and Figure(*loses)}


@pytest.mark.parametrize(
    ("new", "kept"),
    [
        (both(), True),
        (both(knows=(0.9, 0.01), loses=(0.6, 0.05)), True),
        (both(knows=(0.779, 0.001)), False),
        (both(knows=(0.775, 0.02)), True),  # within two standard errors of the difference
        (both(knows=(0.785, 0.0001)), True),  # certain, but too small to count
        (both(knows=(0.9, 0.01), loses=(0.0, 0.02)), False),  # better in one does not make up for the other
        (both(loses=None), True),
        (both(knows=(0.5, 0.01), loses=None), False),
    ],
)
def test_clearly_worse_is_two_standard_errors_and_a_margin(new, kept):
    old = both(knows=(0.8, 0.001))
    assert judge(old, new).kept == kept


def test_the_verdict_names_the_figures():
    better, worse = both(loses=(0.6, 0.05)), both(knows=(0.1, 0.0), loses=(-1.0, 0.0))
    assert "knows 0.80 ± 0.01 -> 0.80 ± 0.01, loses 0.10 ± 0.02 -> 0.60 ± 0.05" in judge(both(), better).why
    assert judge(both(), worse).why.endswith("knows and loses")


def test_what_could_not_be_measured_of_both_refuses_nothing():
    nothing = {KNOWS: None, LOSES: None}
    assert judge(nothing, both()).kept
    assert judge(both(), nothing).kept


def known(value, error):
    return KnownQuantity("speed", 1.0, {"zh_linear": Estimate(value, error), "z_linear": Estimate(0.0, 9.0)})


def losses(*begun):
    rows = (RoadLossComparison(name, 4, {"lost": {"dream": Estimate(*lost)}}) for name, *lost in begun)
    return LossReport(4, 8, 1.0, 10, tuple(rows))


def test_the_figures_are_of_what_was_measured():
    probe = Knowledge(3, 90, (known(0.5, 0.1), known(0.7, 0.3), known(-9.0, 8.0)))
    kinds = losses(("40 steps before", 0.4, 0.03), ("at the loss", 0.9, 0.5), ("no loss", 0.1, 0.04))
    found = figures({"probe": probe, "losses": kinds})
    assert (found[KNOWS].value, found[KNOWS].error) == pytest.approx((0.4, 0.4 / 3))
    assert (found[LOSES].value, found[LOSES].error) == pytest.approx((0.3, 0.05))


@pytest.mark.parametrize(
    "found",
    [None, losses(("40 steps before", 0.4, 0.1)), losses(("no loss", 0.4, 0.1)),
     losses(("40 steps before", 0.4, None), ("no loss", 0.1, 0.04))],
)  # fmt: skip
def test_a_figure_without_both_kinds_of_beginnings_or_errors_is_none(found):
    assert figures({"losses": found}) == {KNOWS: None, LOSES: None}


def test_a_model_whose_dreams_live_less_as_reality_does_is_refused():
    lives = [Survival(40, 1.0, 300, "drawn", (), Estimate(value, 0.01)) for value in (-0.1, -0.7)]
    better, worse = (figures({"survival": each}) for each in lives)
    assert better[SURVIVES] == Figure(-0.1, 0.01)
    assert judge(worse, better).kept
    assert not judge(better, worse).kept
    assert figures({"survival": None})[SURVIVES] is None
