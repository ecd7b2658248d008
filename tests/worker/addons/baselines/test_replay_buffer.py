"""Traces of the replay buffer stay within one episode; an update's equations against numbers worked out by hand.
Tests network.py."""

import numpy as np
import pytest
import torch

from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.addons.baselines.network import Learner, Networks, double_q_target, duelling, masked_loss
from dreamfleet.worker.addons.baselines.presets import AgentConfig, LearningConfig, epsilon_of
from dreamfleet.worker.addons.baselines.replay_buffer import (
    Episode,
    ReplayBuffer,
    first_in_replay,
    n_step,
    slice_padded,
)

CONFIG = LearningConfig(batch=16, trace=4, burn_in=3, n_step=2, gamma=0.5, replay=1000)
REWARDS = [1.0, 2.0, 4.0, 8.0]


def episode(number, length, terminal=True):
    """An episode whose pictures and choices encode the numbers of episode and decision, both from 1."""
    pictures = np.zeros((length, 2, 2, 3), np.uint8)
    pictures[..., 0], pictures[..., 1] = number, np.arange(1, length + 1)[:, None, None]
    return Episode(pictures, np.arange(1, length + 1), np.full(length, float(number), np.float32), terminal)


@pytest.fixture
def replay():
    replay = ReplayBuffer(CONFIG)
    for number, length in enumerate((1, 2, 5, 9, 30), 1):
        replay.add(episode(number, length, terminal=number % 2 == 0))
    return replay


def test_a_trace_never_crosses_an_episode(replay):
    random, found = np.random.default_rng(0), set()
    for _ in range(50):
        for picture in replay.sample(random).picture[:, :, 0, 0, :2]:
            numbers, decisions = picture[picture[:, 0] > 0].T
            assert len(set(numbers)) == 1
            assert (np.diff(decisions.astype(int)) == 1).all()
            found.add(int(numbers[0]))
    assert found == {2, 3, 4, 5}  # of the first, cut after a decision, nothing is known


def test_choices_and_returns_stand_beside_their_pictures(replay):
    random = np.random.default_rng(1)
    for _ in range(20):
        traces = replay.sample(random)
        learnt = traces.picture[:, CONFIG.burn_in : CONFIG.burn_in + CONFIG.trace, 0, 0].astype(int)
        assert (traces.choice == learnt[..., 1]).all()
        follow = traces.picture[:, CONFIG.burn_in + CONFIG.n_step :, 0, 0, 1]
        assert ((follow > 0) == (traces.discount > 0))[traces.mask > 0].all()
        assert (traces.value[traces.discount > 0] == (learnt[..., 0] * 1.5)[traces.discount > 0]).all()
        assert (traces.mask.sum(axis=1) > 0).all()
        before = traces.picture[:, : CONFIG.burn_in, 0, 0, 0] > 0
        assert (before == (traces.real > 0)).all()


def test_the_oldest_episodes_leave_and_the_last_one_stays():
    replay = ReplayBuffer(LearningConfig(replay=10))
    lengths = (4, 4, 4, 30)
    for count, length in enumerate(lengths, 1):
        replay.add(episode(count, length))
        assert len(replay) == count - first_in_replay(list(lengths[:count]), 10)
    assert [first_in_replay(list(lengths[:count]), 10) for count in range(5)] == [0, 0, 0, 1, 3]


def test_where_nothing_is_known_nothing_is_sampled():
    replay = ReplayBuffer(CONFIG)
    replay.add(episode(1, 2, terminal=False))
    assert replay.sample(np.random.default_rng(0)) is None


def test_rows_beyond_an_episode_are_zero():
    assert slice_padded(np.array([1, 2, 3]), -2, 2).tolist() == [0, 0, 1, 2]
    assert slice_padded(np.array([1, 2, 3]), 2, 5).tolist() == [3, 0, 0]
    assert slice_padded(np.array([1, 2, 3]), 5, 7).tolist() == [0, 0]


def test_rewards_of_n_decisions_are_added_up_and_what_a_cut_episode_hides_is_not_learnt():
    returns = n_step(np.array(REWARDS), terminal=True, gamma=0.5, n=2)
    assert returns.value.tolist() == [1 + 1, 2 + 2, 4 + 4, 8]
    assert returns.discount.tolist() == [0.25, 0.25, 0, 0]
    assert n_step(np.array(REWARDS), terminal=False, gamma=0.5, n=2).known.tolist() == [True, True, False, False]
    assert not n_step(np.array(REWARDS[:1]), terminal=False, gamma=0.5, n=2).known.any()


LAYERS = AgentConfig(channels=(2,), kernels=(8,), strides=(8,), hidden=8)
LEARNING = LearningConfig(batch=8, trace=3, burn_in=1, gamma=0.5, rate=1e-2, target_every=5)
RANDOM = np.random.default_rng(0)
EPISODE = Episode(
    RANDOM.integers(0, 256, (3, 64, 64, 3), dtype=np.uint8), np.array([0, 3, 4]), np.array([1, -1, 2], np.float32), True
)


@pytest.fixture
def made():
    torch.manual_seed(0)
    networks = Networks(LAYERS)
    optimiser = torch.optim.Adam(networks.online.parameters(), lr=LEARNING.rate)
    replay = ReplayBuffer(LEARNING)
    replay.add(EPISODE)
    return networks, Learner(networks, optimiser, LEARNING, 0), replay


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


def test_chance_falls_in_a_line_after_the_random_episodes_and_stays():
    config = LearningConfig(random_episodes=50, epsilon_first=0.6, epsilon_last=0.1, epsilon_episodes=100)
    epsilons = [epsilon_of(config, episode) for episode in (0, 49, 50, 100, 150, 1000)]
    assert epsilons == pytest.approx([1, 1, 0.6, 0.35, 0.1, 0.1])


@pytest.mark.parametrize(("kind", "loss"), [("huber", (0.125 + 2.5) / 2), ("squared", (0.25 + 9) / 2)])
def test_losses_count_where_something_is_known(kind, loss):
    predicted, target, mask = torch.tensor([0.5, 3.0, 99.0]), torch.zeros(3), torch.tensor([1.0, 1.0, 0.0])
    assert masked_loss(predicted, target, mask, kind).item() == pytest.approx(loss)
    assert masked_loss(predicted, target, torch.zeros(3), kind).item() == 0
