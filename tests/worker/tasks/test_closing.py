"""Closing environments whose `close` misbehaves."""

import signal
from time import monotonic

import pytest

from dreamfleet.worker.tasks import closing
from dreamfleet.worker.tasks.closing import close_environment
from tests.support.stuck_environments import StuckClose


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
