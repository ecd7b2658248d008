"""Probes, cross-validation folds, R² and estimates."""

import numpy as np
import pytest

from dreamfleet.worker.addons.inspection.probe import (
    Estimate,
    LinearProbe,
    NetworkProbe,
    explained_variance,
    folds,
)


@pytest.fixture
def features():
    return np.random.default_rng(0).normal(size=(3000, 6)) * [1, 2, 0.1, 5, 1, 0] + 3  # the last one says nothing


def test_a_linear_probe_finds_what_is_linear(features):
    targets = np.stack([features[:, 0] - 20 * features[:, 2], 100 + features[:, 3]], axis=1)
    probe = LinearProbe.fit(features[:2000], targets[:2000])
    np.testing.assert_allclose(probe.predict(features[2000:]), targets[2000:], atol=0.02 * targets.std())


def test_weights_say_which_samples_count(features):
    targets = np.where(np.arange(3000) < 2900, 0.0, 1.0)[:, None]
    weights = np.where(targets[:, 0] > 0, 1 / 100, 1 / 2900)
    assert LinearProbe.fit(features, targets).predict(features).mean() == pytest.approx(1 / 30)
    assert LinearProbe.fit(features, targets, weights).predict(features).mean() == pytest.approx(0.5, abs=0.05)


def test_a_network_finds_what_no_line_does_and_the_same_each_time(features):
    targets = np.abs(features[:, :1] - 3)
    linear, layered = (kind.fit(features[:2000], targets[:2000]) for kind in (LinearProbe, NetworkProbe))
    predicted = layered.predict(features[2000:])
    assert explained_variance([targets[2000:]], [linear.predict(features[2000:])])[0].value < 0.1
    assert explained_variance([targets[2000:]], [predicted])[0].value > 0.9
    assert np.array_equal(predicted, NetworkProbe.fit(features[:2000], targets[:2000]).predict(features[2000:]))


@pytest.mark.parametrize("drives", [2, 3, 4, 9])
def test_every_drive_is_judged_once_by_what_was_fitted_without_it(drives):
    parts = list(folds(drives))
    assert sorted(row for part, _ in parts for row in part) == list(range(drives))
    for part, rest in parts:
        assert rest
        assert sorted([*part, *rest]) == list(range(drives))


def test_r_squared_is_one_for_the_truth_and_zero_for_the_mean():
    random = np.random.default_rng(1)
    truths = [random.normal(size=(50, 2)) for _ in range(8)]
    mean = np.concatenate(truths).mean(axis=0)
    assert explained_variance(truths, truths) == [Estimate(1.0, 0.0)] * 2
    for share in explained_variance(truths, [np.tile(mean, (50, 1))] * 8):
        assert share.value == pytest.approx(0)
    noisy = [each + random.normal(size=each.shape) * 0.5 for each in truths]
    for share in explained_variance(truths, noisy):
        assert share.value == pytest.approx(0.75, abs=0.06)
        assert 0 < share.error < 0.05


def test_of_what_never_changes_nothing_is_explained():
    straight = [np.stack([np.zeros(20), np.arange(20.0)], axis=1) for _ in range(3)]
    assert explained_variance(straight, [each + 0.1 for each in straight])[0] == Estimate(0, 0)


def test_an_estimate_is_a_mean_and_its_standard_error():
    assert Estimate.of([1, 2, 3, 4]) == Estimate(2.5, pytest.approx(0.6455, abs=1e-4))
    assert str(Estimate(0.5, 0.049)) == "0.50 ± 0.05"
