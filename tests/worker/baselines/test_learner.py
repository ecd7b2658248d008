"""Updates lead to what choices are worth, and a target network stands still between two renewals."""

import numpy as np
import pytest
import torch

from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.baselines.agent_config import AgentConfig
from dreamfleet.worker.baselines.learner import Learner
from dreamfleet.worker.baselines.learning_config import LearningConfig
from dreamfleet.worker.baselines.network import Networks
from dreamfleet.worker.baselines.replay_buffer import Episode, ReplayBuffer

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


@pytest.mark.slow
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
    with pytest.raises(DatasetError, match="with a lower --rate goes on"):
        learner.learn(replay.sample(RANDOM))
