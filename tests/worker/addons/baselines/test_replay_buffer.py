"""Traces of the replay buffer stay within one episode and keep each number at its decision; n-step returns."""

import numpy as np
import pytest

from dreamfleet.worker.addons.baselines.presets import LearningConfig
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
