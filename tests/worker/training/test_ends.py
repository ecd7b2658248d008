from dataclasses import replace

import numpy as np
import pytest
import torch

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.training.data.rollouts import Rollouts, done_labels
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig

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
        ([-1, -1, -1, 1], "000" + "0"),
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
    with pytest.raises(UsageError, match="--lost is a number of steps that a done head predicts"):
        replace(CONFIG, **values)
