"""A new world model takes the old one's place unless it is clearly worse."""

import pytest

from dreamfleet.experiments.iteration.gate import KNOWS, LOSES, SURVIVES, Figure, figures, judge


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
    assert judge(both(), better).why == "knows 0.80 ± 0.01 -> 0.80 ± 0.01, loses 0.10 ± 0.02 -> 0.60 ± 0.05: kept"
    assert judge(both(), worse).why.endswith(": refused, clearly worse in knows and loses")


def test_what_could_not_be_measured_of_both_refuses_nothing():
    assert judge({KNOWS: None, LOSES: None}, both()).why == "kept: nothing was measured of both"
    assert judge(both(), {KNOWS: None, LOSES: None}).kept


def known(value, error):
    return {"quantity": "speed", "deviation": 1.0, "found": {"zh_linear": {"value": value, "error": error},
                                                            "z_linear": {"value": 0.0, "error": 9.0}}}  # fmt: skip


def begun(name, lost, error):
    return {"begun": name, "count": 4, "figures": {"lost": {"dream": {"value": lost, "error": error}}}}


def test_the_figures_are_those_that_inspect_answers():
    probe = {"probe": {"known": [known(0.5, 0.1), known(0.7, 0.3), known(-9.0, 8.0)]}}
    kinds = [begun("40 steps before", 0.4, 0.03), begun("at the loss", 0.9, 0.5), begun("no loss", 0.1, 0.04)]
    found = figures({"probe": probe, "losses": {"losses": {"begun": kinds}}})
    assert (found[KNOWS].value, found[KNOWS].error) == pytest.approx((0.4, 0.4 / 3))
    assert (found[LOSES].value, found[LOSES].error) == pytest.approx((0.3, 0.05))


@pytest.mark.parametrize(
    "losses",
    [None, {"failed": "drives lost the road 0 times"}, {"losses": {"begun": [begun("40 steps before", 0.4, 0.1)]}},
     {"losses": {"begun": [begun("no loss", 0.4, 0.1)]}}],
)  # fmt: skip
def test_a_figure_without_both_kinds_of_beginnings_is_none(losses):
    assert figures({"losses": losses}) == {KNOWS: None, LOSES: None}


def test_a_model_whose_dreams_live_less_as_reality_does_is_refused():
    answers = [{"survival": {"survival": {"agreement": {"value": value, "error": 0.01}}}} for value in (-0.1, -0.7)]
    better, worse = (figures(each) for each in answers)
    assert better[SURVIVES] == Figure(-0.1, 0.01)
    assert judge(worse, better).kept
    assert judge(better, worse).why == "survives -0.10 ± 0.01 -> -0.70 ± 0.01: refused, clearly worse in survives"
    assert figures({"survival": {"failed": "it predicts no ends"}})[SURVIVES] is None
