"""What a journal's checksums find beside changed bits: rows that are lost, exchanged or not of its version.
Tests checksum_records.py and common/runs/journal/checksums.py."""

from dataclasses import replace

import pytest

from dreamfleet.common.errors import DamagedJournalError
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.settings.fork import Fork
from dreamfleet.coordinator.settings.start import find_start
from dreamfleet.coordinator.storage import recall_records
from tests.support.batch_door import Door
from tests.support.failing_runs import SETTINGS, Failing
from tests.support.journals import change_journal

ENDING = replace(SETTINGS, evaluate_every=1, evaluation_episodes=2)


class Scoring(Failing):
    """Episodes of which a generation's fitness adds up to nearly nothing beside its parts."""

    largest = 1.0

    def fitness_of(self, job):
        sign = -1 if job.candidate % 2 else 1
        return sign * self.largest * (1 + job.candidate // 2 / 3) + 1e-3 * job.candidate


@pytest.fixture
def ended(make_bench):
    """The folder of a run that ended."""
    return end(make_bench(Failing, ENDING, fails=lambda _: False))


def end(bench):
    bench.serve()
    assert bench.run.state.ended
    bench.journal.end_incarnation()
    bench.journal.commit()
    bench.journal.close()
    verify(bench.path)
    return bench.path


def verify(folder):
    with RunFolder(folder) as run:
        run.verify()


def edit(folder, *statements):
    for each in statements:
        change_journal(folder, each)


REST = (
    "candidate, episode, seed, fitness, steps, seconds, worker, fingerprint, incarnation, host_class, measures "
    "FROM result LIMIT 1"
)


@pytest.mark.parametrize(
    "statements",
    [
        ("DELETE FROM evaluation WHERE generation = 1",),
        ("DELETE FROM evaluation",),
        (f"INSERT INTO result SELECT digest, 'other', generation, {REST}",),
        (f"INSERT INTO result SELECT digest, kind, 900, {REST}",),
        # The states before the last two generations change places, with their checksums.
        ("UPDATE strategy SET generation = -generation", "UPDATE strategy SET generation = 5 + generation"),
    ],
)
def test_rows_that_are_lost_added_or_exchanged_are_damage(ended, statements):
    edit(ended, *statements)
    with pytest.raises(DamagedJournalError):
        verify(ended)


@pytest.mark.parametrize("begin", [lambda folder: Fork.of(folder.parent, folder.name, ()),
                                   lambda folder: find_start(folder.name, folder.parent)])  # fmt: skip
def test_no_run_begins_at_a_damaged_one(ended, begin):
    edit(ended, "UPDATE result SET steps = steps + 1000 WHERE generation = 1",
         "DELETE FROM run WHERE key IN ('ended', 'checksum')")  # fmt: skip
    with pytest.raises(DamagedJournalError):
        begin(ended)


@pytest.mark.parametrize("largest", [1.0, 1e9, 1e90])
def test_large_scores_that_cancel_out_are_no_damage(make_bench, largest):
    bench = make_bench(Scoring, ENDING, fails=lambda _: False)
    bench.largest = largest
    end(bench)


@pytest.fixture
def door(tmp_path):
    made = Door(tmp_path / "search")
    for name, first in (("a", 0.0), ("b", 500.0)):
        made.submit(name, first=first)
        made.go_on()
        made.work()
    assert made.query("read", id="b").state == "complete"
    return made


def test_batches_that_exchange_their_scores_are_damage(door):
    door.journal.close()
    verify(door.path)
    edit(door.path, "UPDATE batch SET generation = 9 - generation", "UPDATE batch SET generation = generation - 8")
    with pytest.raises(DamagedJournalError):
        verify(door.path)


def test_a_clock_that_is_set_back_before_a_bar_is_no_damage(door, monkeypatch):
    before = scored(door.path)
    monkeypatch.setattr(recall_records, "time", lambda: 0.0)
    assert not door.run.bar("a")
    assert door.run.commit()
    door.journal.close()
    verify(door.path)
    assert scored(door.path) == before


def scored(folder):
    with RunFolder(folder) as run:
        return [each for each in run.candidates() if each.fitness is not None]
