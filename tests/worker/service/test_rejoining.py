"""A worker after its coordinator restarted, or may have forgotten it."""

from dataclasses import replace
from time import monotonic

import pytest

from dreamfleet.common.errors import RefusedError
from dreamfleet.common.protocol.codec import encode_json
from dreamfleet.common.protocol.messages import Heartbeat, ResultBatch
from tests.support import samples, tasks
from tests.support.hand import DEADLINE, SECOND, SLOW_BEATS, tag, unknown_sender
from tests.support.relay import Relay
from tests.support.stage import wait_for


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
