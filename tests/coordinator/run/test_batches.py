"""Submitted batches without a transport: parts in any order, ids, bounds, restarts anywhere, cancels.
Tests external_generations.py, common/protocol/batches.py, common/runs/journal/candidate_counts.py and
coordinator/storage/batch_records.py."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.protocol.batches import MAX_BATCH, BatchError, BatchHeader, pack_batch
from dreamfleet.common.protocol.messages import MAX_PART
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.run import batches as batches_module
from dreamfleet.coordinator.run.recall import recall
from dreamfleet.coordinator.run.shown_state import shown_state
from dreamfleet.coordinator.storage.verification_records import StoredBar
from tests.support.batch_door import SETTINGS, SIZE, Door, vectors
from tests.support.snapshots import snapshot_of


@pytest.fixture
def door(tmp_path):
    return Door(tmp_path / "search")


def test_a_batch_waits_is_scored_and_is_read(door):
    assert shown_state(door.run).word == "waiting for workers"
    reply = door.submit("a")
    assert (reply.state, reply.is_new, reply.population, reply.episodes) == ("waiting", True, 2, 2)
    door.go_on()
    assert door.query("read", id="a").state == "running"
    door.work(3)
    reply = door.query("read", id="a")
    assert (reply.done, reply.fitness[1]) == (1, None)
    door.work()
    reply = door.query("read", id="a")
    expected = vectors(2).sum(axis=1) + 1.5
    assert (reply.state, reply.done, reply.generation) == ("complete", 2, 0)
    assert reply.fitness == tuple(expected.tolist())
    assert door.submit("a") == replace(reply, is_new=False)
    assert door.run.history.last.mean == expected.mean()


def test_batches_are_listed_open_ones_first(door):
    for each in "abcd":
        door.submit(each, first=ord(each))
    door.go_on()
    assert door.run.journal.batches.open_count() == 4
    door.work()
    door.query("cancel", id="c")
    listed = [(each.id, each.state, each.generation) for each in door.query("list").batches]
    assert listed == [("b", "running", 1), ("d", "waiting", None), ("c", "cancelled", None), ("a", "complete", 0)]
    assert door.run.journal.batches.open_count() == 2


def test_parts_arrive_in_any_order_and_again(door):
    header, body = pack_batch("large", vectors(2000), [1])
    order = [*range(len(range(0, len(body), MAX_PART)))]
    assert len(order) > 1
    reply = door.send(header, body, [order[-1], *order[:-1][::-1], order[0]])
    assert reply.state == "waiting"
    door.go_on()
    assert [len(each.vector) for each in door.run.generation.missing] == [4 * SIZE] * 2000
    damaged, wrong = pack_batch("damaged", vectors(1), [1])
    assert door.send(damaged, wrong[:-1] + b"\x7f").refused == "malformed"
    assert door.send(damaged, wrong).state == "waiting"


def test_an_id_names_one_content_and_a_refused_batch_leaves_it_free(door):
    door.submit("a")
    for other in ({"first": 1.0}, {"seeds": (1, 3)}, {"seeds": (), "episodes": 2}, {"count": 3}):
        assert door.submit("a", **other).refused == "conflict"
    assert door.submit("b", size=SIZE + 1).refused == "malformed"
    header, body = pack_batch("b", vectors(1), [1])
    for spoilt in (body[:8] + np.full(SIZE, np.nan, "<f4").tobytes(), np.array([-1], "<i8").tobytes() + body[8:]):
        sha256 = hashlib.sha256(spoilt).hexdigest()
        assert door.send(replace(header, sha256=sha256), spoilt).refused == "malformed"
    assert door.send(header, body).is_new
    for verb, name, refused in (("read", "c", "unknown"), ("cancel", "c", "unknown"), ("read", "a/b", "malformed"),
                                ("steal", "a", "malformed")):  # fmt: skip
        assert door.query(verb, id=name).refused == refused
    assert door.query("read", id="a", offset="x").refused == "malformed"
    assert door.query("read", id="a", offset=10**9).fitness == ()


def test_what_waits_is_bounded(door, monkeypatch):
    headers = [pack_batch(f"half-{number}", vectors(3000), [1])[0] for number in range(100)]
    replies = [door.query("submit", bytes(MAX_PART), **vars(each), offset=0) for each in headers]  # they never end
    assert (replies[0].refused, replies[-1].refused) == ("", "busy")
    door.now += 61.0
    door.batches.tick(door.now)
    monkeypatch.setattr(batches_module, "MAX_WAITING", 3)
    door.submit("open")
    door.go_on()
    assert [door.submit(f"w{each}").refused for each in range(4)] == ["", "", "", "busy"]
    assert door.submit("w0").state == "waiting"  # known ones are found all the same
    with pytest.raises(BatchError):
        BatchHeader("large", MAX_BATCH, 2, 0, 1, 64 * "0")


def test_a_job_of_two_batches_is_scored_once(door):
    door.submit("a")
    door.submit("b", count=3, seeds=(2, 3))  # shares two jobs with it
    door.go_on()
    door.work()
    door.work()
    assert len(door.scored) == len(set(door.scored)) == 4 + 4
    assert [each.steps for each in door.run.history.rows] == [4 * 7, 4 * 7]
    assert door.query("read", id="b").fitness == tuple((vectors(3).sum(axis=1) + 2.5).tolist())


@pytest.mark.parametrize("done", range(9))
def test_a_restart_anywhere_loses_no_batch_and_no_score(door, done):
    door.submit("a", count=2)
    door.submit("b", count=2, first=9.0)
    door.go_on()
    for _ in range(done):
        door.work(1)
    door.submit("c")
    door.restart()
    assert door.query("read", id="c").refused == "unknown", "it was not committed"
    while door.run.generation.population:
        door.work(1)
    assert len(door.scored) == len(set(door.scored)) == 8
    assert door.query("read", id="a").fitness == tuple((vectors(2).sum(axis=1) + 1.5).tolist())
    assert door.query("read", id="b").fitness == tuple((vectors(2, 9.0).sum(axis=1) + 1.5).tolist())
    assert door.run.generations.mean == bytes(4 * SIZE)
    assert door.run.background_jobs.report.current is None


@pytest.mark.parametrize("is_closed", [False, True])
def test_while_the_disk_is_full_reads_say_what_is_durable_and_nothing_is_taken(door, is_closed):
    door.submit("a")
    door.submit("b", first=9.0)
    door.go_on()
    door.work(2)
    before, listed = door.query("read", id="a"), door.query("list").batches
    assert (before.state, before.done) == ("running", 1)
    door.score()
    if is_closed:
        door.run.advance(door.now)
    pages = door.journal.read_row("PRAGMA page_count")[0]
    door.journal._connection.execute(f"PRAGMA max_page_count = {pages + 10}")
    refused = door.submit("large", count=9000)
    stalled = door.run.state.stalled
    assert (refused.refused, refused.run_state) == ("busy", "paused")
    assert stalled.why in refused.why
    for _ in range(2):
        read = door.query("read", id="a")
        assert read == replace(before, run_state="paused", run_why=stalled.why)
        assert door.query("list").batches == listed
        assert [door.query("cancel", id="b").refused, door.submit("small").refused] == ["busy", "busy"]
    door.journal._connection.execute("PRAGMA max_page_count = 1000000")
    door.run.tick(stalled.retry_at)
    door.go_on()
    door.go_on()
    assert door.query("read", id="a").done == 2
    assert door.query("read", id="a").state == "complete"
    assert door.submit("large", count=9000).state == "waiting"
    assert door.submit("small").is_new


@pytest.mark.parametrize("is_killed", [False, True])
def test_a_cancelled_batch_keeps_its_scores(door, is_killed):
    door.submit("a", count=3)
    door.submit("b")
    door.submit("c", first=5.0)
    door.go_on()
    door.work(2)
    assert door.query("cancel", id="b").state == "cancelled"
    assert door.query("cancel", id="a").state == "cancelled"
    assert snapshot_of(door).status.generation.failed == 0
    if is_killed:
        door.run.commit()
        door.restart()
    door.go_on()
    reply = door.query("read", id="a")
    assert (reply.done, reply.fitness[1:]) == (3, (None, None))
    assert [(each.candidate, each.error) for each in reply.errors] == [(1, "cancelled"), (2, "cancelled")]
    assert (door.run.generation.number, door.run.history.last.failed) == (1, 0)
    door.work()
    assert door.query("cancel", id="c").state == "complete"
    assert door.submit("b").state == "cancelled"


def test_fresh_seeds_differ_from_batch_to_batch(door):
    replies = [door.submit(each, seeds=(), episodes=number) for each, number in (("a", 3), ("b", 3), ("c", 0))]
    assert [each.episodes for each in replies] == [3, 3, SETTINGS.episodes]
    seeds = [door.journal.batches.find(each).seeds for each in "abc"]
    assert len({each for some in seeds for each in some}) == 8


def test_batches_of_others_share_results_and_keep_them_after_a_recall(door):
    door.submit("one", 2, seeds=(1, 2))
    door.submit("again", 3, seeds=(1, 2, 2))
    door.submit("cut", 3, seeds=(5, 6))
    for _ in range(2):
        door.go_on()
        door.work()
    door.go_on()
    door.work(3)
    door.query("cancel", id="cut")
    door.go_on()
    with RunFolder(door.path) as run:
        before = run.candidates(), [each.steps for each in run.history()]
        assert [each.episodes for each in before[0]] == [2, 2, 3, 3, 3, 2, 0, 0]
        assert [sum(each.steps for each in before[0] if each.generation == number) for number in range(3)] == before[1]
    door.journal.verification.bar("a", StoredBar("a test"), 1)
    recall(door.journal, SETTINGS, {"a"})
    door.journal.commit()
    with RunFolder(door.path) as run:
        assert (run.candidates(), [each.steps for each in run.history()]) == before
