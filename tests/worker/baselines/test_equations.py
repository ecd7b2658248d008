"""One equation each, against numbers that were worked out by hand."""

import numpy as np
import pytest
import torch

from dreamfleet.worker.baselines.equations import double_q_target, duelling, masked_loss
from dreamfleet.worker.baselines.learning_config import LearningConfig, epsilon_of
from dreamfleet.worker.baselines.replay_buffer import n_step

REWARDS = [1.0, 2.0, 4.0, 8.0]


def test_the_streams_are_combined_with_the_mean_of_the_advantages_taken_off():
    worth = duelling(torch.tensor([[10.0]]), torch.tensor([[1.0, 2.0, 6.0]]))
    assert worth.tolist() == [[8.0, 9.0, 13.0]]
    shifted = duelling(torch.tensor([[10.0]]), torch.tensor([[101.0, 102.0, 106.0]]))
    torch.testing.assert_close(shifted, worth)


def test_the_online_network_chooses_and_the_target_network_says_what_it_is_worth():
    online, target = torch.tensor([[1.0, 5.0, 2.0]]), torch.tensor([[7.0, 3.0, 9.0]])
    assert double_q_target(torch.tensor([1.0]), torch.tensor([0.5]), online, target).tolist() == [1 + 0.5 * 3]


def test_nothing_is_foretold_behind_a_terminal():
    returns = n_step(np.array(REWARDS), terminal=True, gamma=0.5, n=1)
    assert returns.discount.tolist() == [0.5, 0.5, 0.5, 0.0]
    assert returns.known.all()
    huge = torch.full((4, 3), 1e6)
    target = double_q_target(torch.from_numpy(returns.value), torch.from_numpy(returns.discount), huge, huge)
    assert target[-1] == 8.0


def test_rewards_of_n_decisions_are_added_up_and_discounted():
    returns = n_step(np.array(REWARDS), terminal=True, gamma=0.5, n=2)
    assert returns.value.tolist() == [1 + 1, 2 + 2, 4 + 4, 8]
    assert returns.discount.tolist() == [0.25, 0.25, 0, 0]


def test_what_a_cut_episode_hides_is_not_learnt():
    returns = n_step(np.array(REWARDS), terminal=False, gamma=0.5, n=2)
    assert returns.known.tolist() == [True, True, False, False]
    assert not n_step(np.array(REWARDS[:1]), terminal=False, gamma=0.5, n=2).known.any()


def test_chance_falls_in_a_line_after_the_random_episodes_and_stays():
    config = LearningConfig(random_episodes=50, epsilon_first=0.6, epsilon_last=0.1, epsilon_episodes=100)
    told = [epsilon_of(config, episode) for episode in (0, 49, 50, 100, 150, 1000)]
    assert told == pytest.approx([1, 1, 0.6, 0.35, 0.1, 0.1])


@pytest.mark.parametrize(("kind", "loss"), [("huber", (0.125 + 2.5) / 2), ("squared", (0.25 + 9) / 2)])
def test_losses_count_where_something_is_known(kind, loss):
    told, target, mask = torch.tensor([0.5, 3.0, 99.0]), torch.zeros(3), torch.tensor([1.0, 1.0, 0.0])
    assert masked_loss(told, target, mask, kind).item() == pytest.approx(loss)
    assert masked_loss(told, target, torch.zeros(3), kind).item() == 0
