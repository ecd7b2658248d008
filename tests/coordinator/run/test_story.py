"""What happened to a run, in its journal."""

from dataclasses import replace

import pytest

from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.run.run import BY_HAND
from dreamfleet.coordinator.storage.journal import MAX_EVENTS
from tests.support.failing_runs import SETTINGS, Failing
from tests.support.run_bench import A


@pytest.fixture
def bench(tmp_path, random_bundle):
    made = Failing(tmp_path / "night", random_bundle.path, replace(SETTINGS), fails=lambda job: job.candidate == 1)
    yield made
    made.journal.close()


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
    bench.now += 1
    bench.run.tick(bench.now)
    found = texts(bench)
    assert "was killed, crashed" not in "".join(text for _, text in found)
    expected = [
        (1, "incarnation 1 begins"), (1, "joined"), (1, "paused: by hand"), (1, "resumed"),
        (1, "the coordinator leaves"),
        (2, "incarnation 2 begins"), (2, "candidate 0/1, seed"), (2, "counts as failed"), (2, "ended: 3 generations"),
        (2, f"worker {A} is lost: it was killed, or its connection was cut"),
    ]  # fmt: skip
    places = [next(i for i, (life, text) in enumerate(found) if life == number and part in text)
              for number, part in expected]  # fmt: skip
    assert places == sorted(places), "\n".join(map(str, found))


def test_an_incarnation_that_did_not_leave_by_itself_is_named(bench):
    bench.restart()
    assert (2, "incarnation 2 begins; the last one was killed, crashed or could not write") in texts(bench)


def test_the_journal_keeps_the_last_events_only(bench):
    for number in range(MAX_EVENTS + 50):
        bench.journal.add_event(str(number))
    found = texts(bench)
    assert len(found) == MAX_EVENTS
    assert any(text == str(MAX_EVENTS + 49) for _, text in found)
