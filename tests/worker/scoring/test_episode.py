"""An episode's score, and what made one fail. Tests failure_cause.py."""

import errno
import signal
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.common.protocol.failures import MAX_CAUSE
from dreamfleet.worker.scoring.episode import MAX_OFF_COURSE_STEPS, EpisodeConfig, score
from dreamfleet.worker.scoring.failure_cause import MAX_TEXT, crash, failure_of, is_hosts_fault

PARAMETERS = np.zeros(3, np.float32)


class Scripted(gymnasium.Env):
    observation_space = spaces.Box(-1, 1, (1,))
    action_space = spaces.Box(-1, 1, (1,))

    def __init__(self, rewards, info=None):
        self._rewards, self._info = rewards, info or {}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._step = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self._step += 1
        over = self._step == len(self._rewards)
        return np.zeros(1, np.float32), self._rewards[self._step - 1], over, False, self._info if over else {}


class Still:
    def begin(self, parameters):
        pass

    def act(self, observation):
        return np.zeros(1)


def drive(rewards, info=None, horizon=100, **settings):
    """The score of an episode with these rewards, under a policy that does nothing."""
    return score(Scripted(rewards, info), Still(), PARAMETERS, EpisodeConfig(1, horizon, **settings))


@pytest.mark.parametrize(("horizon", "fitness", "steps"), [(2, 3.0, 2), (3, 6.5, 3), (100, 6.5, 3)])
def test_fitness_is_the_sum_of_rewards_until_the_end_or_the_horizon_and_each_step_is_reported(horizon, fitness, steps):
    class Listening(Still):
        heard = ()

        def reward(self, value):
            self.heard += (value,)

    policy, reported = Listening(), []
    found = score(Scripted([1.0, 2.0, 3.5]), policy, PARAMETERS, EpisodeConfig(1, horizon), reported.append)
    assert (found.fitness, found.steps) == (fitness, steps)
    assert reported == list(range(1, steps + 1))
    assert policy.heard == (1.0, 2.0, 3.5)[:steps]


def test_an_episode_that_patience_cuts_is_charged_for_standing_still():
    rewards = [3.0] + [-0.1] * 99
    cut = drive(rewards, patience=20, idle_cost=0.1)
    assert cut.steps == 21
    assert cut.fitness == pytest.approx(drive(rewards).fitness)


@pytest.mark.parametrize(
    ("rewards", "info", "paid"),
    [
        ([1.0] * 8, {"lap": True}, 8),  # finished
        ([1.0] * 8, {"lap": False}, 20),  # crashed
        ([1.0] * 8, {}, 20),
        ([1.0] * 40, {}, 20),  # reached the horizon
        ([1.0] + [0.0] * 39, {}, 20),  # cut by patience
    ],
)
def test_time_is_charged_until_the_course_is_finished_and_after_a_crash(rewards, info, paid):
    free, dear = (drive(rewards, info, 20, patience=5, finish="lap", time_cost=cost) for cost in (0.0, 0.5))
    assert free.fitness - dear.fitness == 0.5 * paid
    assert free.steps == dear.steps


class OffCourse(Scripted):
    def __init__(self, rewards, off_course_steps):
        super().__init__(rewards)
        self._off_course_steps = off_course_steps

    def step(self, action):
        *given, _ = super().step(action)
        return (*given, {"off": self._step in self._off_course_steps})


@pytest.mark.parametrize(
    ("off_course_steps", "paid"), [((), 0), ((3,), 1), (range(5, 9), 4), (range(1, 180), MAX_OFF_COURSE_STEPS)]
)
def test_steps_off_the_course_are_charged_up_to_a_limit(off_course_steps, paid):
    free = EpisodeConfig(1, 200, off_course="off")
    course = free, replace(free, off_course_cost=2.0)
    found = [score(OffCourse([0.0] * 199, off_course_steps), Still(), PARAMETERS, each) for each in course]
    assert found[0].fitness - found[1].fitness == 2 * paid
    assert found[0].steps == found[1].steps


def test_reward_restores_patience():
    assert drive(([-0.1] * 9 + [1.0]) * 5, patience=10).steps == 50


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_sum_that_is_not_finite_is_an_error(value):
    for parameters, reward in ((np.full(3, value, np.float32), 1.0), (PARAMETERS, value)):
        with pytest.raises(ValueError):
            score(Scripted([reward]), Still(), parameters, EpisodeConfig(1, 10))


class Demanding(Scripted):
    """An environment that takes finite actions alone, and begins with a given observation."""

    def __init__(self, first):
        super().__init__([1.0])
        self._first = first

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.array([self._first]), {}

    def step(self, action):
        if not np.isfinite(action).all():
            raise ZeroDivisionError
        return super().step(action)


class Copying(Still):
    def act(self, observation):
        return np.float32(observation) * np.float32(0)


class Lost(Still):
    def act(self, observation):
        return np.full(1, np.nan)


@pytest.mark.parametrize("first", [1e300, np.nan, -np.inf])
@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_a_failure_at_an_action_that_an_observation_made_nan_names_the_observation(first):
    with pytest.raises(ValueError) as caught:
        score(Demanding(first), Copying(), PARAMETERS, EpisodeConfig(1, 10))
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_other_failures_of_an_environment_stay_as_they_are():
    assert score(Demanding(1.0), Copying(), PARAMETERS, EpisodeConfig(1, 10)).steps == 1
    with pytest.raises(ZeroDivisionError):
        score(Demanding(1.0), Lost(), PARAMETERS, EpisodeConfig(1, 10))


def raised_from(cause):
    try:
        raise ValueError("the world cannot be made") from cause
    except ValueError as error:
        return error


HOST = [
    MemoryError(),
    *(OSError(number, "") for number in (errno.ENOSPC, errno.EROFS, errno.EMFILE)),
    BlockingIOError(errno.EAGAIN, "no process left"),
    RuntimeError("can't start new thread"),
    raised_from(OSError(errno.ENOMEM, "no memory")),
    -signal.SIGKILL,
]
OTHER = [
    ValueError("x"), FileNotFoundError(errno.ENOENT, "no file"), RuntimeError("the road has ended"), raised_from(None),
    SystemExit(1), 0, 3, -signal.SIGSEGV, -signal.SIGTERM,
]  # fmt: skip


@pytest.mark.parametrize("cause", [*HOST, *OTHER], ids=repr)
def test_who_is_at_fault_follows_from_the_error_or_the_exit_status(cause):
    is_status, is_host = isinstance(cause, int), cause in HOST
    assert is_hosts_fault(cause) == is_host
    found = crash(cause) if is_status else failure_of(cause)
    assert found.kind == ("host" if is_host else "crash" if is_status else "other")


@pytest.mark.parametrize(
    ("reason", "cause"),
    [(3, "exit status 3"), (-signal.SIGSEGV, "killed by SIGSEGV"), (-63, "killed by signal 63"), ("stuck", "stuck")],
)
def test_equal_ends_of_a_child_have_an_equal_cause(reason, cause):
    found = crash(reason)
    assert (found.cause, found.kind, found.ends_process) == (cause, "crash", True)


def test_the_cause_is_the_class_whatever_the_message_says():
    found = failure_of(ValueError("host: UsageError: slot crashed (exit status 3)"))
    assert (found.cause, found.kind, found.ends_process) == ("ValueError", "other", False)


def test_the_text_of_an_expected_error_stands_alone():
    for error, kind in ((UsageError("give --task"), "usage"), (BundleError("it is damaged"), "other")):
        found = failure_of(error)
        assert (found.text, found.cause, found.kind) == (str(error), type(error).__name__, kind)


def test_the_text_is_one_short_line_that_can_be_sent():
    failure = failure_of(ValueError("\udc80\0" + "x" * 10_000_000 + "\nsecond"))
    assert failure.text.startswith(r"ValueError: \udc80\x00xxx")
    assert len(failure.text) == MAX_TEXT
    assert failure.text.encode()
    odd = failure_of(type("a:b\n" * 1000, (Exception,), {})())
    assert 0 < len(odd.cause) <= MAX_CAUSE
    assert odd.cause.isprintable()
