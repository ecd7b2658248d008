"""A worker against a coordinator driven by hand, over a real router."""

import hashlib
import logging
import queue
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from dreamfleet.common.bundle import BundleStore, Manifest, default_cache, write_bundle
from dreamfleet.common.codec import encode
from dreamfleet.common.errors import BundleError, RefusedError, UsageError
from dreamfleet.common.messages import MAX_MESSAGE, MAX_PART, Beat, Intervals, ResultBatch, UploadPart
from dreamfleet.common.session import Network
from dreamfleet.worker.service import membership
from dreamfleet.worker.service.config import WorkerConfig
from dreamfleet.worker.service.worker import Worker
from tests.support import tasks
from tests.support.bundles import npy
from tests.support.hand import DEADLINE, SECOND, Hand, tag
from tests.support.processes import free_port
from tests.support.relay import Relay
from tests.support.samples import MSGPACK

pytestmark = pytest.mark.timeout(60)
PARTS = 6  # of the small bundle
SLOW_BEATS = Intervals(beat=2 * DEADLINE, repeat=0.1)


@pytest.fixture(scope="module")
def small_bundle(tmp_path_factory):
    """No world model, only as many bytes: the toy tasks do not look inside."""
    parts = dict.fromkeys(("encoder.onnx", "decoder.onnx"), b"x")
    parts["initial_latents.npy"] = npy(np.zeros((1, 2, 4), np.float32))
    manifest = Manifest("small", "toy", "none", (64, 64, 3), latent=4, hidden=4, actions=3)
    path = tmp_path_factory.mktemp("bundle") / "small.zip"
    return write_bundle(path, manifest, {**parts, "policy.onnx": bytes((PARTS - 1) * MAX_PART)})


@pytest.fixture
def cached(small_bundle):
    with BundleStore(default_cache()).downloading(small_bundle.sha256) as path:
        path.write_bytes(small_bundle.path.read_bytes())
    BundleStore(default_cache()).complete(small_bundle.sha256)


class Stage:
    """Workers and hand-driven coordinators that end with the test."""

    def __init__(self, bundle):
        self.bundle = bundle
        self.port = free_port()
        self.workers, self.hands = [], []
        self._threads = ThreadPoolExecutor()

    def hand(self, task=tasks.TOY, **more):
        self.hands.append(Hand(self.port, self.bundle, task, **more))
        return self.hands[-1]

    def worker(self, endpoint=None, **config):
        """A worker and the future of its `serve`."""
        config = WorkerConfig(**{"run": "test", "slots": 1, **config})
        made = Worker(config, Network(connect=(endpoint or f"tcp/127.0.0.1:{self.port}",)))
        self.workers.append((made, self._threads.submit(made.serve)))
        return self.workers[-1]

    def close(self):
        for made, served in self.workers:
            made.stop()
            made.stop()
            served.exception(DEADLINE)
        for each in self.hands:
            each.close()
        self._threads.shutdown()


@pytest.fixture
def stage(small_bundle):
    made = Stage(small_bundle)
    yield made
    made.close()


@pytest.fixture
def said():
    """What a worker logs, waited for with `get`."""
    lines = queue.SimpleQueue()
    handler = logging.Handler()
    handler.emit = lambda record: lines.put(record.getMessage())
    logger = logging.getLogger("dreamfleet.worker")
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    yield lines
    logger.removeHandler(handler)
    logger.setLevel(before)


def wait_for(lines, text):
    while text not in (line := lines.get(timeout=DEADLINE)):
        pass
    return line


def test_it_waits_for_a_coordinator_that_starts_later(stage, said, cached):
    stage.worker()
    wait_for(said, "waiting for a coordinator")
    assert stage.hand().ready().slots == 1


def test_a_slot_that_can_score_is_told_at_once(stage, cached):
    hand = stage.hand()
    hand.intervals = SLOW_BEATS
    stage.worker()
    hand.hello()
    assert [hand.beat().capacity, hand.beat().capacity] == [0, 1]


def test_it_waits_until_its_run_is_there(stage, said, cached):
    stage.hand(run="another")
    stage.worker()
    wait_for(said, "waiting for run test")


def test_without_a_name_it_joins_the_only_run(stage, cached):
    hand = stage.hand(run="night")
    stage.worker(run=None)
    assert hand.ready().slots == 1


def test_without_a_name_several_runs_are_listed(stage, cached):
    hand = stage.hand(run="night")
    other = Hand(free_port(), stage.bundle, tasks.TOY, run="day")
    answer = hand.session.declare_queryable("dreamfleet/hello/day", other._hello)
    _, served = stage.worker(run=None)
    assert isinstance(error := served.exception(DEADLINE), UsageError)
    assert "day, night" in str(error)
    answer.undeclare()
    other.close()


def test_a_refusal_ends_it_with_the_reason_and_the_remedy(stage):
    stage.hand().refusal = ("your moon is full", "wait a week")
    _, served = stage.worker()
    error = served.exception(DEADLINE)
    assert isinstance(error, RefusedError)
    assert "your moon is full; wait a week" in str(error)


def test_a_result_is_repeated_until_its_verdict_and_then_no_more(stage, cached):
    hand = stage.hand()
    stage.worker()
    hand.ready()
    first, second = hand.job(0), hand.job(1)
    hand.send(1, first)
    told = [hand.result(first) for _ in range(3)]
    assert told[0].fitness is not None
    assert told[0] == told[1] == told[2]
    assert hand.beat(lambda beat: beat.unacked).unacked == (tag(first),)
    hand.send(2, second, accepted=(first,))
    hand.beat(lambda beat: tag(first) not in beat.unacked and beat.seen == 2)
    for _ in range(3):
        assert hand.results(second) == {second.digest}


def test_a_batch_number_that_came_already_is_ignored(stage, cached):
    hand = stage.hand()
    stage.worker()
    hand.ready()
    first, smuggled, last = hand.job(0), hand.job(1), hand.job(2)
    hand.send(1, first)
    hand.send(1, smuggled)
    hand.send(2, last)
    assert hand.results(first, last) == {first.digest, last.digest}
    assert hand.beat(lambda beat: beat.seen == 2 and not beat.running).unacked == (tag(first), tag(last))


def test_a_lost_batch_shows_in_the_beats_until_it_is_sent_again(stage, cached):
    hand = stage.hand()
    stage.worker()
    hand.ready()
    lost, later = hand.job(0), hand.job(1)
    hand.send(1)
    hand.send(3, later)
    hand.result(later)
    assert hand.beat().seen == 1
    hand.send(2, lost)
    hand.result(lost)
    assert hand.beat(lambda beat: beat.seen != 1).seen == 3


def test_what_is_foreign_or_malformed_is_dropped_and_counted(stage, cached):
    hand = stage.hand()
    made, _ = stage.worker()
    hand.ready()
    foreign, mine = hand.job(0), hand.job(1)
    hand.send(1, foreign, nonce=SECOND)
    hand.send(1, foreign, run_uid="f" * 32)
    for payload in (b"", b"\xc1", bytes(MAX_MESSAGE + 1), encode(MSGPACK["beat"])):
        hand.put(payload)
    hand.send(1, mine)
    assert hand.results(mine) == {mine.digest}
    assert made.inbox.dropped == {"foreign coordinator": 2, "not msgpack": 2, "oversize": 1, "wrong fields": 1}


def test_a_job_that_is_not_what_its_digest_says_is_an_error(stage, cached):
    hand = stage.hand()
    stage.worker()
    hand.ready()
    job = MSGPACK["job"].jobs[0]  # of another run's task
    hand.send(1, job)
    assert "digest" in hand.result(job).error


def test_a_drive_is_uploaded_again_until_its_verdict_and_then_no_more(stage, cached):
    hand = stage.hand(tasks.HEAVY)
    stage.worker()
    hand.ready()
    kept, other = hand.job(0, "collect"), hand.job(1)
    hand.send(1, kept)
    data = hand.upload(kept)
    assert len(data) > 3 * MAX_PART
    assert hand.result(kept).upload == hashlib.sha256(data).digest()
    assert hand.upload(kept) == data
    hand.send(2, other, accepted=(kept,))
    hand.beat(lambda beat: beat.seen == 2 and tag(kept) not in beat.unacked)
    for _ in range(3):
        assert isinstance(hand.next((UploadPart, Beat)), Beat)


def test_a_coordinators_next_life_hears_a_drive_from_the_beginning(stage, cached):
    hand = stage.hand(tasks.HEAVY)
    stage.worker()
    hand.ready()
    kept = hand.job(0, "collect")
    hand.send(1, kept)
    data = hand.upload(kept)
    hand.vanish()
    hand.nonce, hand.incarnation = SECOND, 2
    hand.appear()
    hand.beat(lambda beat: beat.nonce == SECOND and tag(kept) in beat.unacked)
    assert hand.next(UploadPart).incarnation == 2
    assert hand.upload(kept) == data


def test_a_cancelled_job_is_not_started(stage, cached):
    hand = stage.hand(tasks.SLOW_TOY)
    stage.worker()
    hand.ready()
    running, cancelled, last = (hand.job(number) for number in range(3))
    hand.send(1, running, cancelled, last)
    hand.beat(lambda beat: tag(cancelled) in beat.queued and tag(running) in {each.tag for each in beat.running})
    hand.send(2, cancels=(cancelled.digest,))
    assert hand.results(running, last) == {running.digest, last.digest}


def test_its_queue_stands_still_while_too_many_results_have_no_verdict(stage, cached):
    hand = stage.hand()
    stage.worker()
    hand.ready()
    jobs = [hand.job(number) for number in range(8)]
    hand.send(1, *jobs)
    stuck = hand.beat(lambda beat: len(beat.unacked) == 5)
    assert stuck.queued == tuple(tag(job) for job in jobs[5:])
    hand.send(2, accepted=jobs[:5])
    hand.beat(lambda beat: beat.unacked == tuple(tag(job) for job in jobs[5:]))


def test_it_follows_its_run_into_the_coordinators_next_life(stage, cached):
    hand = stage.hand(tasks.SLOW_TOY)
    stage.worker()
    hand.ready()
    done, running, queued = (hand.job(number) for number in range(3))
    hand.send(1, done, running, queued)
    hand.result(done)
    hand.beat(lambda beat: [each.tag for each in beat.running] == [tag(running)])
    hand.vanish()
    hand.nonce, hand.incarnation = SECOND, 2
    hand.appear()
    hand.hello()
    beat = hand.beat(lambda beat: beat.nonce == SECOND)
    assert (beat.incarnation, beat.seen, beat.queued) == (2, 0, ())
    assert tag(done) in beat.unacked
    assert hand.next(ResultBatch).incarnation == 2
    assert hand.results(done, running) == {done.digest, running.digest}
    hand.send(1, queued)
    assert hand.result(queued).fitness is not None


@pytest.fixture
def relay(stage):
    made = Relay(stage.port)
    yield made
    made.close()


def test_a_cut_connection_makes_it_say_hello_again(stage, relay, cached):
    hand = stage.hand()
    hand.intervals = SLOW_BEATS  # so that no silence is long enough to be what it notices
    stage.worker(relay.endpoint)
    hand.ready()
    first, second = hand.job(0), hand.job(1)
    hand.send(1, first)
    hand.result(first)
    relay.cut()
    hand.hello()
    assert hand.beat(lambda beat: beat.seen == 0).unacked == (tag(first),)
    hand.send(1, second)
    assert hand.results(first, second) == {first.digest, second.digest}


@pytest.mark.parametrize("owed", [True, False])
def test_a_coordinator_that_has_nothing_to_say_is_asked_whether_it_knows_the_worker(stage, cached, owed):
    hand = stage.hand()
    stage.worker()
    hand.ready()
    if owed:
        hand.send(1, hand.job())
        hand.result(hand.job())
    hand.hello()


def test_another_run_of_the_same_name_ends_it(stage, cached):
    hand = stage.hand()
    _, served = stage.worker()
    hand.ready()
    hand.vanish()
    hand.nonce, hand.run_uid = SECOND, "f" * 32
    hand.appear()
    assert isinstance(served.exception(DEADLINE), RefusedError)


@pytest.mark.parametrize("when", ["before it joined", "afterwards"])
def test_it_leaves_when_its_run_is_over_if_it_shall(stage, cached, monkeypatch, when):
    monkeypatch.setattr(membership, "GONE", 0.3)
    hand = stage.hand()
    if when == "before it joined":
        hand.vanish()
    _, served = stage.worker(exit_when_done=True)
    hand.hello()
    if when == "afterwards":
        hand.beat(lambda beat: beat.capacity > 0)
        hand.vanish()
    assert served.result(DEADLINE) is None


def test_told_to_stop_it_finishes_what_runs_and_delivers(stage, cached):
    hand = stage.hand(tasks.SLOW_TOY)
    made, served = stage.worker()
    hand.ready()
    running, queued = hand.job(0), hand.job(1)
    hand.send(1, running, queued)
    hand.beat(lambda beat: beat.running)
    made.stop()
    assert hand.beat(lambda beat: beat.capacity == 0).queued == ()
    assert hand.result(running).fitness is not None
    assert not served.done()
    hand.send(2, accepted=(running,))
    assert served.result(DEADLINE) is None


def test_told_twice_it_leaves_what_runs(stage, said, cached):
    hand = stage.hand(tasks.SLOW_TOY)
    made, served = stage.worker()
    hand.ready()
    hand.send(1, hand.job())
    hand.beat(lambda beat: beat.running)
    made.stop()
    made.stop()
    assert served.result(DEADLINE) is None
    wait_for(said, "leaving: 0 jobs")


def test_told_to_stop_it_leaves_a_download(stage):
    hand = stage.hand()
    hand.damage = lambda offset, data: None
    made, served = stage.worker()
    hand.offsets.get(timeout=DEADLINE)
    made.stop()
    assert served.result(2) is None


def test_a_damaged_part_costs_one_more_download(stage, said):
    hand = stage.hand()
    spoilt = iter([bytes(MAX_PART)[:-1] + b"!"])
    hand.damage = lambda offset, data: next(spoilt, data) if offset == 2 * MAX_PART else data
    stage.worker()
    assert "arrived damaged" in wait_for(said, "attempt 1 of 3")
    hand.ready()
    asked = [hand.offsets.get_nowait() for _ in range(hand.offsets.qsize())]
    assert asked.count(2 * MAX_PART) == 2


def test_a_bundle_that_is_always_damaged_is_an_error_that_says_so(stage):
    hand = stage.hand()
    hand.damage = lambda offset, data: data[::-1]
    _, served = stage.worker()
    error = served.exception(DEADLINE)
    assert isinstance(error, BundleError)
    assert "damaged 3 times" in str(error)


@pytest.mark.parametrize(("beginning", "first"), [(3 * MAX_PART + 17, 3 * MAX_PART + 17), (9 * MAX_PART, 9 * MAX_PART)])
def test_an_interrupted_download_goes_on_and_a_longer_one_begins_again(stage, beginning, first):
    hand = stage.hand()
    with BundleStore(default_cache()).downloading(stage.bundle.sha256) as path:
        path.write_bytes((stage.bundle.path.read_bytes() + bytes(9 * MAX_PART))[:beginning])
    stage.worker()
    hand.ready()
    asked = [hand.offsets.get_nowait() for _ in range(hand.offsets.qsize())]
    assert asked[0] == first
    assert (0 in asked) == (beginning > 7 * MAX_PART)
