"""A worker receives and delivers correctly although messages are lost, repeated, foreign or hostile, and after its
coordinator restarted, or may have forgotten it.
Tests run_session.py, sender.py, backlog.py, failure_log.py, membership.py and outbox.py."""

import hashlib
import re
from dataclasses import replace
from time import monotonic

import pytest

from dreamfleet.common.errors import RefusedError
from dreamfleet.common.protocol.codec import encode, encode_json
from dreamfleet.common.protocol.messages import MAX_MESSAGE, MAX_PART, Heartbeat, ResultBatch, UploadPart
from dreamfleet.worker.service.run_session import RunSession
from tests.support import samples, tasks
from tests.support.hand import DEADLINE, SECOND, SLOW_BEATS, tag, unknown_sender
from tests.support.relay import Relay
from tests.support.samples import MSGPACK
from tests.support.stage import drained, wait_for


def test_a_result_is_repeated_until_its_verdict(stage, cached):
    hand, *_ = stage.served()
    first, second = hand.job(0), hand.job(1)
    hand.send(1, first)
    results = [hand.result(first) for _ in range(3)]
    assert results[0].fitness is not None
    assert results[0] == results[1] == results[2]
    assert hand.beat(lambda beat: beat.unacked).unacked == (tag(first),)
    hand.send(2, second, accepted=(first,))
    hand.beat(lambda beat: tag(first) not in beat.unacked and beat.seen == 2)
    for _ in range(3):
        assert hand.results(second) == {second.digest}


def test_foreign_and_malformed_messages_are_dropped_and_counted(stage, cached):
    hand, made, _ = stage.served()
    foreign, mine = hand.job(0), hand.job(1)
    hand.send(1, foreign, nonce=SECOND)
    hand.send(1, foreign, run_uid="f" * 32)
    for payload in (b"", b"\xc1", bytes(MAX_MESSAGE + 1), encode(MSGPACK["beat"])):
        hand.put(payload)
    hand.send(1, mine)
    assert hand.results(mine) == {mine.digest}
    assert made.inbox.dropped == {"foreign coordinator": 2, "not msgpack": 2, "oversize": 1, "schema": 1}


def test_a_batch_that_raises_costs_only_itself(stage, cached, said, monkeypatch):
    hand, *_ = stage.served()
    with monkeypatch.context() as patch:
        patch.setattr(RunSession, "_handle_batch", lambda *_: 1 / 0)
        hand.send(1, hand.job())
        wait_for(said, "ZeroDivisionError")
    hand.send(1, hand.job())
    assert hand.result(hand.job()).fitness is not None


def test_a_job_whose_content_differs_from_its_digest_is_an_error(stage, cached):
    hand, *_ = stage.served()
    job = MSGPACK["job"].jobs[0]  # of another run's task
    hand.send(1, job)
    assert "digest" in hand.result(job).error.text


def test_a_rollout_is_uploaded_repeatedly_until_its_verdict(stage, cached):
    hand, *_ = stage.served(tasks.HEAVY)
    kept, other = hand.job(0, "collect"), hand.job(1)
    hand.send(1, kept)
    data = hand.upload(kept)
    assert len(data) > 3 * MAX_PART
    assert hand.result(kept).upload == hashlib.sha256(data).digest()
    assert hand.upload(kept) == data
    hand.send(2, other, accepted=(kept,))
    hand.beat(lambda beat: beat.seen == 2 and tag(kept) not in beat.unacked)
    for _ in range(3):
        assert isinstance(hand.next((UploadPart, Heartbeat)), Heartbeat)


def test_nothing_starts_while_too_many_results_have_no_verdict(stage, cached):
    hand, *_ = stage.served()
    jobs = [hand.job(number) for number in range(8)]
    hand.send(1, *jobs)
    stuck = hand.beat(lambda beat: len(beat.unacked) == 5)
    assert stuck.queued == tuple(tag(job) for job in jobs[5:])
    hand.send(2, accepted=jobs[:5])
    hand.beat(lambda beat: beat.unacked == tuple(tag(job) for job in jobs[5:]))


def test_a_failing_task_logs_its_traceback_once_with_its_job(stage, said, cached):
    hand, *_ = stage.served(tasks.RAISING)
    jobs = [hand.job(number) for number in range(3)]
    hand.send(1, *jobs)
    hand.results(*jobs)
    logged = wait_for(said, "Traceback")
    assert re.search(rf"{re.escape(tasks.RAISING)}.*candidate 7/2, seed {jobs[0].seeds[0]}", logged)
    assert 'raise RuntimeError("the road has ended")' in logged
    assert not [line for line in drained(said) if "Traceback" in line]


@pytest.mark.slow
def test_it_follows_its_run_into_the_coordinators_next_life(stage, cached):
    hand, _, served = stage.served(tasks.SLOW_TOY, exit_when_done=True)
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
    assert not served.done()


@pytest.mark.slow
def test_a_batch_of_a_newer_numbering_makes_it_say_hello(stage, cached):
    hand, *_ = stage.served(tasks.SLOW_TOY)
    done, running, queued, later = (hand.job(number) for number in range(4))
    hand.send(1, done, running, queued)
    hand.result(done)
    hand.numbering += 1
    hand.send(1, later)
    hand.hello()
    hand.send(1, later)
    beat = hand.beat(lambda beat: beat.numbering == hand.numbering and beat.seen == 1)
    assert tag(queued) not in beat.queued
    assert hand.results(done, later) >= {done.digest, later.digest}
    hand.send(2, queued, numbering=hand.numbering - 1)
    hand.send(2, hand.job(4))
    assert hand.result(hand.job(4)).fitness is not None
    assert queued.digest not in hand.results(hand.job(4)), "a batch of the numbering before was late"


def test_a_coordinator_that_comes_back_as_another_version_is_said_once_and_at_once(stage, cached, caplog):
    def notes():
        facts = (getattr(record, "facts", {}) for record in caplog.records if record.levelname == "WARNING")
        return [each["package"] for each in facts if each.get("event") == "other version"]

    hand, *_ = stage.served()
    assert not notes(), "it is of the worker's own version"
    hand.vanish()
    hand.nonce, hand.incarnation, hand.package = SECOND, 2, "9.9.dev1+gabc"
    hand.appear()
    hand.hello()
    hand.beat(lambda beat: beat.nonce == SECOND)
    assert notes() == ["9.9.dev1+gabc"]
    hand.numbering += 1
    hand.send(1)  # it says hello again
    hand.hello()
    hand.send(1, hand.job(0))
    assert hand.result(hand.job(0)).fitness is not None
    assert notes() == ["9.9.dev1+gabc"]


@pytest.fixture
def relay(stage):
    made = Relay(stage.port)
    yield made
    made.close()


def test_a_cut_connection_makes_it_say_hello_again(stage, relay, cached):
    hand = stage.hand()
    hand.intervals = SLOW_BEATS  # so long that silence cannot be what makes it say hello
    stage.worker(relay.endpoint)
    hand.ready()
    first, second = hand.job(0), hand.job(1)
    hand.send(1, first)
    hand.result(first)
    relay.cut()
    began = monotonic()
    hand.hello()
    assert monotonic() - began < SLOW_BEATS.beat, "it waited for silence"
    assert hand.beat(lambda beat: beat.seen == 0).unacked == (tag(first),)
    hand.send(1, second)
    assert hand.results(first, second) == {first.digest, second.digest}


def test_it_says_hello_to_a_silent_coordinator(stage, cached):
    hand, *_ = stage.served()
    hand.hello()


@pytest.mark.slow
def test_it_follows_its_run_to_another_name_with_its_results(stage, said, cached):
    hand, *_ = stage.served(tasks.SLOW_TOY)
    done, running = hand.job(0), hand.job(1)
    hand.send(1, done, running)
    hand.result(done)
    hand.leave()
    again = stage.also(hand, tasks.SLOW_TOY, run="test-rescued")
    again.nonce, again.incarnation = SECOND, 2
    wait_for(said, "test-rescued")
    again.hello()
    assert again.results(done, running) == {done.digest, running.digest}
    again.next(Heartbeat)  # it listens under this name
    again.send(1, again.job(2), accepted=(done, running))
    assert again.result(again.job(2)).fitness is not None


@pytest.mark.slow
def test_it_stays_with_its_name_where_the_run_is_refused_under_another(stage, said, cached):
    hand, *_ = stage.served()
    hand.leave()
    stage.also(hand, run="other").refusal = ("your moon is full", "wait")
    wait_for(said, "moon")
    stage.also(hand).ready()


@pytest.mark.parametrize("leaves", [False, True])
def test_another_run_of_the_same_name_is_joined_anew_or_ends_a_worker_with_exit_when_done(stage, cached, leaves):
    hand, _, served = stage.served(exit_when_done=leaves)
    hand.vanish()
    hand.nonce, hand.run_uid = SECOND, "f" * 32
    hand.appear()
    if leaves:
        assert isinstance(served.exception(DEADLINE), RefusedError)
    else:
        assert hand.beat(lambda beat: beat.run_uid == "f" * 32).slots == 1
        assert not served.done()


def test_an_unknown_sender_that_answers_as_another_run_does_not_end_its_membership(stage, relay, cached):
    hand = stage.hand()
    stage.worker(relay.endpoint)
    hand.ready()
    other = replace(samples.JSON["hello-reply"], run="test", run_uid="f" * 32, accepted=True)
    with unknown_sender(hand, "dreamfleet/hello/test", lambda _: encode_json(other)):
        relay.cut()
        hand.hello()
        hand.send(1, hand.job())
        assert hand.result(hand.job()).fitness is not None
