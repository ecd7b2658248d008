"""A worker receives and delivers correctly although messages are lost, repeated, foreign or hostile.
Tests run_session.py and sender.py."""

import hashlib
import re

from dreamfleet.common.protocol.codec import encode
from dreamfleet.common.protocol.messages import MAX_MESSAGE, MAX_PART, Heartbeat, UploadPart
from dreamfleet.worker.service.run_session import RunSession
from tests.support import tasks
from tests.support.hand import SECOND, tag
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
