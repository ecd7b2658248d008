"""The equations of an update against numbers worked out by hand; updates converge, and the target network lags.
Tests network.py."""

import numpy as np
import pytest
import torch

from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.addons.baselines.network import Learner, Networks, double_q_target, duelling, masked_loss
from dreamfleet.worker.addons.baselines.presets import AgentConfig, LearningConfig, epsilon_of
from dreamfleet.worker.addons.baselines.replay_buffer import Episode, ReplayBuffer, n_step

LAYERS = AgentConfig(channels=(2,), kernels=(8,), strides=(8,), hidden=8)
CONFIG = LearningConfig(batch=8, trace=3, burn_in=1, gamma=0.5, rate=1e-2, target_every=5)
RANDOM = np.random.default_rng(0)
EPISODE = Episode(
    RANDOM.integers(0, 256, (3, 64, 64, 3), dtype=np.uint8), np.array([0, 3, 4]), np.array([1, -1, 2], np.float32), True
)


@pytest.fixture
def made():
    torch.manual_seed(0)
    networks = Networks(LAYERS)
    optimiser = torch.optim.Adam(networks.online.parameters(), lr=CONFIG.rate)
    replay = ReplayBuffer(CONFIG)
    replay.add(EPISODE)
    return networks, Learner(networks, optimiser, CONFIG, 0), replay


@pytest.mark.long
def test_choices_become_worth_their_rewards_and_the_best_that_follows(made):
    networks, learner, replay = made
    losses = [learner.learn(replay.sample(RANDOM)) for _ in range(400)]
    with torch.no_grad():
        worth, _ = networks.online(networks.online.features(torch.from_numpy(EPISODE.picture[None])))
    found, best = worth[0, range(3), EPISODE.choice], worth[0].amax(dim=-1)
    assert losses[-1] < losses[0] / 100
    wanted = torch.tensor([1 + 0.5 * best[1], -1 + 0.5 * best[2], 2.0])
    torch.testing.assert_close(found, wanted, atol=0.1, rtol=0)


def test_the_target_is_the_online_network_of_a_while_ago(made):
    networks, learner, replay = made
    begun = networks.online.value.weight.clone()
    for _ in range(4):
        learner.learn(replay.sample(RANDOM))
    assert torch.equal(networks.target.value.weight, begun)
    learner.learn(replay.sample(RANDOM))
    assert torch.equal(networks.target.value.weight, networks.online.value.weight)
    assert not networks.target.value.weight.requires_grad


def test_a_loss_that_is_no_number_is_said(made):
    networks, learner, replay = made
    with torch.no_grad():
        networks.online.value.bias.fill_(float("inf"))
    with pytest.raises(DatasetError, match="--rate"):
        learner.learn(replay.sample(RANDOM))


def test_the_streams_are_combined_with_the_mean_of_the_advantages_taken_off():
    worth = duelling(torch.tensor([[10.0]]), torch.tensor([[1.0, 2.0, 6.0]]))
    assert worth.tolist() == [[8.0, 9.0, 13.0]]
    shifted = duelling(torch.tensor([[10.0]]), torch.tensor([[101.0, 102.0, 106.0]]))
    torch.testing.assert_close(shifted, worth)


def test_the_online_network_chooses_and_the_target_network_says_what_it_is_worth():
    online, target = torch.tensor([[1.0, 5.0, 2.0]]), torch.tensor([[7.0, 3.0, 9.0]])
    assert double_q_target(torch.tensor([1.0]), torch.tensor([0.5]), online, target).tolist() == [1 + 0.5 * 3]


def test_no_value_follows_a_terminal():
    returns = n_step(np.array([1.0, 2.0, 4.0, 8.0]), terminal=True, gamma=0.5, n=1)
    assert returns.discount.tolist() == [0.5, 0.5, 0.5, 0.0]
    assert returns.known.all()
    huge = torch.full((4, 3), 1e6)
    target = double_q_target(torch.from_numpy(returns.value), torch.from_numpy(returns.discount), huge, huge)
    assert target[-1] == 8.0


def test_chance_falls_in_a_line_after_the_random_episodes_and_stays():
    config = LearningConfig(random_episodes=50, epsilon_first=0.6, epsilon_last=0.1, epsilon_episodes=100)
    epsilons = [epsilon_of(config, episode) for episode in (0, 49, 50, 100, 150, 1000)]
    assert epsilons == pytest.approx([1, 1, 0.6, 0.35, 0.1, 0.1])


@pytest.mark.parametrize(("kind", "loss"), [("huber", (0.125 + 2.5) / 2), ("squared", (0.25 + 9) / 2)])
def test_losses_count_where_something_is_known(kind, loss):
    predicted, target, mask = torch.tensor([0.5, 3.0, 99.0]), torch.zeros(3), torch.tensor([1.0, 1.0, 0.0])
    assert masked_loss(predicted, target, mask, kind).item() == pytest.approx(loss)
    assert masked_loss(predicted, target, torch.zeros(3), kind).item() == 0
