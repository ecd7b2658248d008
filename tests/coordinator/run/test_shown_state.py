"""How a run's state is shown."""

import pytest

from dreamfleet.common.errors import NotWritableNowError
from dreamfleet.coordinator.run.run import BY_HAND, PAUSED
from dreamfleet.coordinator.run.shown_state import ShownState, shown_state


@pytest.fixture
def bench(begin):
    return begin()


def test_a_run_that_ends_in_a_pause_shows_why_it_ended(bench):
    bench.run.pause(BY_HAND)
    assert shown_state(bench.run) == ShownState("paused", BY_HAND.text, (BY_HAND.kind,))
    bench.run.resume()
    bench.serve()
    bench.journal.set_fact(PAUSED, BY_HAND.text)
    bench.restart()
    assert shown_state(bench.run) == ShownState("ended", bench.run.state.ended.text)


def test_an_end_that_cannot_be_written_is_shown_as_a_pause_until_it_is(bench, monkeypatch):
    commit, is_full = bench.journal.commit, True

    def commit_with_room():
        if is_full and bench.run.state.ended:
            raise NotWritableNowError("full")
        commit()

    monkeypatch.setattr(bench.journal, "commit", commit_with_room)
    bench.serve()
    assert bench.run.state.ended
    assert shown_state(bench.run) == ShownState("paused", bench.run.state.stalled.why)
    is_full = False
    bench.run.leave()
    assert shown_state(bench.run).word == "ended"
