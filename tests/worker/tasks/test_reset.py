"""Environments that take no long seeds, and those whose `reset` or `close` misbehaves. Tests closing.py."""

import signal
from contextlib import suppress
from time import monotonic

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from dreamfleet.common.runs.seeds import fold_seed, training_seed
from dreamfleet.worker.tasks import closing
from dreamfleet.worker.tasks.closing import close_environment
from dreamfleet.worker.tasks.reset import reset_folded
from tests.support.stuck_environments import StuckClose

LONG, LONGEST = training_seed(7, 0, 0), 2**53 - 1


class Environment(gymnasium.Env):
    """Its observation is the seed; `fails(seed, number)` raises for the reset of that number."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = spaces.Discrete(2)

    def __init__(self, fails):
        self.seeds, self._fails = [], fails

    def reset(self, *, seed=None, options=None):
        self.seeds.append(seed)
        if (error := self._fails(seed, len(self.seeds))) is not None:
            raise error
        return np.array([seed], np.float64), {}


@pytest.mark.parametrize("error", [ValueError("too long"), OverflowError("int too big"), TypeError("32 bits")])
@pytest.mark.parametrize("limit", [2**31, 2**32])
def test_an_environment_that_refuses_long_seeds_gets_them_folded(error, limit):
    environment = Environment(lambda seed, _: error if seed >= limit else None)
    assert reset_folded(environment, LONG)[0] == fold_seed(LONG)
    assert reset_folded(environment, LONG + 1)[0] == fold_seed(LONG + 1)
    assert reset_folded(environment, 5)[0] == 5


@pytest.mark.parametrize(
    "refuses", [lambda seed: seed >= 2**52, lambda seed: seed % 9 == LONGEST % 9, lambda seed: seed == LONGEST]
)
def test_what_a_seed_means_does_not_depend_on_the_seeds_before(refuses):
    environment = Environment(lambda seed, _: ValueError("no such level") if refuses(seed) else None)
    legal = next(seed for seed in range(LONG % 2**51, 2**52) if not refuses(seed))
    assert reset_folded(environment, legal)[0] == legal
    with pytest.raises(ValueError, match="no such level"):
        reset_folded(environment, LONGEST)
    assert reset_folded(environment, legal)[0] == legal


@pytest.mark.parametrize("error", [RuntimeError("no answer"), ValueError("no answer"), MemoryError(), OSError(24, "x")])
def test_a_reset_that_fails_by_chance_is_an_error_and_no_other_seed(error):
    for period in (3, 4, 5):
        environment = Environment(lambda _, number, period=period: error if number % period == 0 else None)
        found = []
        for each in range(12):
            with suppress(type(error)):
                assert reset_folded(environment, LONG + each)[0] == LONG + each
                found.append(each)
        assert 2 <= len(found) <= 10


def test_a_close_that_hangs_is_interrupted_and_not_called_again_and_another_is_whose_interrupt_passes(
    monkeypatch, caplog
):
    class Interrupted(StuckClose):
        def close(self):
            raise KeyboardInterrupt

    monkeypatch.setattr(closing, "CLOSE_LIMIT", 0.2)
    monkeypatch.setattr(closing, "_hung", {})
    StuckClose.calls.clear()
    before, began = signal.getsignal(signal.SIGALRM), monotonic()
    fault = close_environment(StuckClose())
    assert StuckClose.__name__ in fault
    assert caplog.messages == [fault]
    assert close_environment(StuckClose()) == fault
    assert monotonic() - began < 60
    assert len(StuckClose.calls) == 1
    assert signal.getsignal(signal.SIGALRM) == before
    assert signal.getitimer(signal.ITIMER_REAL) == (0, 0)
    with pytest.raises(KeyboardInterrupt):
        close_environment(Interrupted())
