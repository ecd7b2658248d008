"""What happened to a run, in its journal, and how its state is shown. Tests shown_state.py."""

import pytest

from dreamfleet.common.errors import NotWritableNowError
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.run.run import BY_HAND, PAUSED
from dreamfleet.coordinator.run.shown_state import ShownState, shown_state
from dreamfleet.coordinator.storage.journal import MAX_EVENTS
from tests.support.run_bench import A


@pytest.fixture
def bench(begin):
    return begin(lambda job: job.candidate == 1)


def texts(bench):
    bench.run.take_notes()
    bench.journal.commit()
    with RunFolder(bench.path) as folder:
        return [(each.incarnation, each.text) for each in folder.events()]


def test_comings_failures_pauses_and_lives_are_kept_in_order(bench):
    bench.run.pause(BY_HAND)
    bench.run.resume()
    bench.run.leave()
    bench.restart()
    bench.serve()
    bench.run.fleet.handle_departure(A, bench.now)
    bench.wait()
    found = texts(bench)
    expected = [(1, "incarnation 1"), (1, A), (1, BY_HAND.text), (2, "incarnation 2"), (2, "0/1"),
                (2, "3 generations")]  # fmt: skip
    places = [next(i for i, (life, text) in enumerate(found) if life == number and part in text)
              for number, part in expected]  # fmt: skip
    assert places == sorted(places), "\n".join(map(str, found))
    assert A in found[-1][1], "its loss"


def test_an_incarnation_that_did_not_leave_by_itself_is_named(bench):
    bench.run.leave()
    bench.restart()
    bench.restart()  # as after a kill
    begun = dict(reversed(texts(bench)))
    assert begun[3] != begun[2].replace("2", "3")


def test_the_journal_keeps_the_last_events_only(bench):
    for number in range(MAX_EVENTS + 50):
        bench.journal.add_event(str(number))
    found = texts(bench)
    assert len(found) == MAX_EVENTS
    assert any(text == str(MAX_EVENTS + 49) for _, text in found)


def test_a_run_that_ends_in_a_pause_shows_why_it_ended(begin):
    bench = begin()
    bench.run.pause(BY_HAND)
    assert shown_state(bench.run) == ShownState("paused", BY_HAND.text, (BY_HAND.kind,))
    bench.run.resume()
    bench.serve()
    bench.journal.set_fact(PAUSED, BY_HAND.text)
    bench.restart()
    assert shown_state(bench.run) == ShownState("ended", bench.run.state.ended.text)


def test_an_end_that_cannot_be_written_is_shown_as_a_pause_until_it_is(begin, monkeypatch):
    bench = begin()
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
