"""Closing environments whose `close` misbehaves."""

import signal
from time import monotonic

import pytest

from dreamfleet.worker.tasks import closing
from dreamfleet.worker.tasks.closing import close_environment
from tests.support.stuck_environments import StuckClose


@pytest.fixture
def brief(monkeypatch):
    monkeypatch.setattr(closing, "CLOSE_LIMIT", 0.2)
    monkeypatch.setattr(closing, "_hung", {})
    StuckClose.calls.clear()


def test_a_close_that_hangs_is_interrupted_and_not_called_again(brief, caplog):
    before = signal.getsignal(signal.SIGALRM)
    began = monotonic()
    fault = close_environment(StuckClose())
    assert StuckClose.__name__ in fault
    assert caplog.messages == [fault]
    assert close_environment(StuckClose()) == fault
    assert monotonic() - began < 60
    assert len(StuckClose.calls) == 1
    assert signal.getsignal(signal.SIGALRM) == before
    assert signal.getitimer(signal.ITIMER_REAL) == (0, 0)


def test_another_close_is_still_called(brief):
    close_environment(StuckClose())

    class Sound(StuckClose):
        def close(self):
            self.calls.append(self)

    assert close_environment(Sound()) == ""
    assert len(StuckClose.calls) == 2
