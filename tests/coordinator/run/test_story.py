"""What happened to a run, in its journal."""

import pytest

from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.run.run import BY_HAND
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
