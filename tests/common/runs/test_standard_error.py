from math import sqrt

import numpy as np
import pytest

from dreamfleet.common.runs.records import StoredConfirmation, StoredEvaluation, describe_score, format_mean, with_error
from dreamfleet.common.runs.standard_error import format_with_error, sample_std, standard_error


def test_a_standard_error_has_the_samples_standard_deviation():
    assert sample_std([1.0, 3.0]) == pytest.approx(sqrt(2))  # with n in the denominator 29 % less
    assert (sample_std([5.0]), standard_error([5.0])) == (None, None)


@pytest.mark.parametrize("episodes", [2, 64])
def test_an_evaluation_and_a_confirmation_of_equal_scores_have_equal_errors(episodes):
    """An evaluation is stored with the population's standard deviation, a confirmation with the sample's."""
    scores = np.random.default_rng(episodes).normal(500, 100, episodes)
    evaluation = StoredEvaluation(1, episodes, float(scores.mean()), float(scores.std()))
    confirmation = StoredConfirmation(1, episodes, float(scores.mean()), float(scores.std(ddof=1)), 2)
    expected = pytest.approx(scores.std(ddof=1) / sqrt(episodes))
    assert (evaluation.error, confirmation.error, standard_error(scores.tolist())) == (expected, expected, expected)


@pytest.mark.parametrize("found", [StoredEvaluation(3, 1, 812.5, 0.0), StoredConfirmation(3, 1, 812.5, 0.0, 4)])
def test_one_episode_has_no_error_wherever_it_is_read(found):
    assert found.error is None
    assert with_error(found)["error"] is None
    assert format_mean(found) == "812.5"
    assert "±" not in describe_score(found)


def test_a_small_score_has_enough_digits_and_a_zero_no_sign():
    shown = {
        "-3.5": (-3.5, None), "0.123 ± 0.003": (0.1234, 0.0031), "0.00042": (0.00042, None), "500.0 ± 0": (500.0, 0.0),
        "0.0 ± 2.0": (-0.01, 2.0), "0.0": (-0.0, None), "812": (812.4, None, 0), "1,234.6 ± 7,890.1": (1234.56, 7890.1),
    }  # fmt: skip
    assert {text: format_with_error(*figures) for text, figures in shown.items()} == {text: text for text in shown}
    assert format_with_error(0.5, 0.25, 2, sign="+") == "+0.50 ± 0.25"
