from dataclasses import replace

import numpy as np
import pytest
import torch

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.training.data.rollouts import Rollouts, done_labels
from dreamfleet.worker.training.prediction_quality import end_quality
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN, binary_loss
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig, calibrate_end
from tests.support.drives import write_encoded

CONFIG = MDNRNNConfig(latent=1, hidden=4, done=True, lost=3)


def drives(*rewards, ended=False):
    """Rollouts with these rewards, padded; `ended` says whether the last one ended."""
    length = max(map(len, rewards))
    reward, mask, done = (np.zeros((len(rewards), length), np.float32) for _ in range(3))
    for row, each in enumerate(rewards):
        reward[row, : len(each)], mask[row, : len(each)] = each, 1
    done[-1, len(rewards[-1]) - 1] = ended
    latents, actions = np.zeros((len(rewards), length, 1), np.float32), np.zeros((len(rewards), length, 3), np.float32)
    return Rollouts(*map(torch.from_numpy, (latents, latents, actions, reward, done, mask)))


@pytest.mark.parametrize(
    ("rewards", "lost"),
    [
        ([1, 1, 1, 1, 1, 1], "000000"),
        ([1, -1, -1, -1, 1, 1], "100000"),  # three steps without reward follow the first one
        ([1, -1, -1, 1, 1, 1], "000000"),
        ([1, -1, -1, -1, -1, 1, 1], "1100000"),
        ([1, 1, -1, -1, -1], "00000"),  # whether it came back was not seen
        ([1, 1, -1, -1, -1, -1], "011111"),  # given up
        ([-1, -1, -1, -1], "1111"),  # it never moved
        ([-1, -1, -1, 1], "0000"),
    ],
)
def test_a_step_is_lost_where_no_reward_follows_for_so_long(rewards, lost):
    found = done_labels(CONFIG, drives(rewards))
    assert "".join(str(int(each)) for each in found[0]) == lost


def test_padding_is_no_loss_and_changes_none():
    short, long = [1.0, -1, -1, -1, -1], [1.0] * 12
    found = done_labels(CONFIG, drives(short, long))
    assert (found[0, :5] == done_labels(CONFIG, drives(short))[0]).all()
    assert not found[0, 5:].any()
    assert not found[1].any()


def test_where_an_episode_ended_it_ends_too():
    assert done_labels(CONFIG, drives([1.0] * 5, ended=True))[0].tolist() == [0, 0, 0, 0, 1]
    plain = replace(CONFIG, lost=0)
    assert done_labels(plain, drives([1.0, -1, -1, -1, -1, -1], ended=True))[0].tolist() == [0, 0, 0, 0, 0, 1]


@pytest.mark.parametrize("values", [{"lost": -1}, {"lost": 5, "done": False}])
def test_steps_of_a_loss_need_a_done_head(values):
    with pytest.raises(UsageError):
        replace(CONFIG, **values)


@pytest.mark.parametrize("weight", [1.0, 3.0, 10.0])
def test_a_weighted_head_learns_odds_that_are_so_much_too_high_until_they_are_calibrated(weight):
    labels = torch.zeros(1, 1000)
    labels[0, :50] = 1
    logit = torch.zeros(1, requires_grad=True)
    optimiser = torch.optim.LBFGS([logit], max_iter=100)

    def loss():
        optimiser.zero_grad()
        value = binary_loss(logit.expand(1, 1000), labels, torch.ones(1, 1000), weight)
        value.backward()
        return value

    optimiser.step(loss)
    learnt = torch.sigmoid(logit).item()
    assert learnt / (1 - learnt) == pytest.approx(weight * 0.05 / 0.95, rel=1e-3)
    assert calibrate_end(learnt, weight) == pytest.approx(0.05, rel=1e-3)


def test_certain_ends_stay_certain_and_without_a_weight_no_bit_changes():
    found = np.random.default_rng(0).random(1000, np.float32)
    assert calibrate_end(found, 1.0) is found
    assert calibrate_end(np.array([0, 1], np.float32), 7.0).tolist() == [0, 1]
    assert calibrate_end(found, 7.0).dtype == np.float32


@pytest.mark.parametrize("weight", [1.0, 4.0])
def test_the_quality_of_ends_is_of_calibrated_probabilities(tmp_path, weight):
    model = MDNRNN(MDNRNNConfig(latent=1, hidden=4, reward="none", done=True, done_weight=weight))
    with torch.no_grad():  # it predicts an end with probability 0.2 at every step
        model.heads.weight.zero_()
        model.heads.bias.fill_(np.log(weight * 0.2 / 0.8))
    figures = end_quality(model, write_encoded(tmp_path, np.zeros((45, 10)), latent=1, ended=True))
    assert figures == pytest.approx({"done_brier": 0.1 * 0.8**2 + 0.9 * 0.2**2, "done_calibration": 2})
    assert end_quality(MDNRNN(replace(model.config, done=False, done_weight=1)), []) == {}
