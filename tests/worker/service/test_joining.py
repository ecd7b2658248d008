"""How a worker joins a run: it waits, is welcomed or is refused. Tests admission.py, config.py and worker.py."""

import os
import queue
import re
from dataclasses import dataclass, replace
from time import monotonic

import pytest

from dreamfleet.common.artifacts.bundle import write_bundle
from dreamfleet.common.errors import RefusedError, UsageError
from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES, fingerprint
from dreamfleet.common.protocol.codec import encode_json
from dreamfleet.common.protocol.messages import Intervals, ResultBatch, TaskSpec
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.worker.service.child import ScorerArguments
from dreamfleet.worker.service.config import WorkerConfig
from dreamfleet.worker.service.slot import Slot
from dreamfleet.worker.service.worker import Worker
from tests.support import samples, tasks
from tests.support.hand import DEADLINE, SECOND, Hand
from tests.support.processes import free_port
from tests.support.stage import drained, wait_for

SLOW_BEATS = Intervals(beat=60.0, repeat=0.1)  # the longest valid ones


@dataclass(frozen=True)
class OfTomorrow(TaskSpec):
    """A specification with a field of a later version."""

    later: float = 0.5


@pytest.mark.slow
def test_it_waits_for_a_coordinator_that_starts_later(stage, said, cached):
    stage.worker()
    wait_for(said, f"tcp/127.0.0.1:{stage.port}")
    assert stage.hand().ready().slots == 1


def test_a_slot_that_can_score_is_reported_at_once(stage, cached):
    hand = stage.hand()
    hand.intervals = SLOW_BEATS
    stage.worker()
    hand.hello()
    began = monotonic()
    assert [hand.beat().capacity, hand.beat().capacity] == [0, 1]
    assert monotonic() - began < SLOW_BEATS.beat, "it waited for the next beat"


def test_it_waits_until_its_run_is_there(stage, said, cached):
    stage.hand(run="another")
    stage.worker()
    wait_for(said, "run test")


def test_without_a_name_it_joins_the_only_run(stage, cached):
    hand = stage.hand(run="night")
    stage.worker(run=None)
    assert hand.ready().slots == 1


@pytest.mark.slow
def test_without_a_name_several_runs_are_listed_until_one_is_left(stage, said, cached):
    hand = stage.hand(run="night")
    other = Hand(free_port(), stage.bundle, tasks.TOY, run="day")
    answer = hand.session.declare_queryable("dreamfleet/hello/day", other._hello)
    stage.worker(run=None)
    wait_for(said, "day, night")
    answer.undeclare()
    hand.ready()
    other.close()


def test_it_says_hello_again_with_the_packages_of_the_runs_fingerprint(stage, cached):
    hand = stage.hand()
    hand.packages = ("numpy", "no-such-package")
    stage.worker()
    first, second = hand.hello(), hand.hello()
    assert (first.packages, second.packages) == (NUMERIC_PACKAGES, hand.packages)
    assert "gymnasium" in first.fingerprint
    assert second.fingerprint == fingerprint(hand.packages)
    assert "gymnasium" not in second.fingerprint
    assert hand.beat(lambda beat: beat.capacity > 0).slots == 1


@pytest.mark.slow
def test_a_refusal_is_logged_once_for_each_reason_and_the_run_is_asked_again(stage, said, cached):
    hand = stage.hand()
    hand.refusal = ("your moon is full", "wait a week")
    stage.worker()
    assert re.search(r"your moon is full.* wait a week.* 1\b", wait_for(said, "moon"))
    for _ in range(2):
        hand.hello()
    assert not [line for line in drained(said) if "moon" in line]
    hand.refusal = ("your moon is new", "wait a week")
    wait_for(said, "your moon is new")
    hand.refusal = None
    assert hand.ready().slots == 1


def test_one_answer_of_several_is_enough_to_join(stage, cached):
    """A stranger that claims to answer every query completely answers first, and refuses."""
    hand = stage.hand()
    refusal = replace(samples.JSON["hello-reply"], run="test", accepted=False, why="go away", remedy="far away")
    with open_session(Network(connect=(hand.endpoint,))) as session:
        session.declare_queryable("dreamfleet/**", lambda query: say(query, refusal), complete=True)
        stage.worker()
        assert hand.ready().slots == 1


def say(query, reply):
    with query:
        query.reply(query.key_expr, encode_json(reply))


def test_a_refusal_ends_a_worker_with_exit_when_done(stage):
    stage.hand().refusal = ("your moon is full", "wait a week")
    _, served = stage.worker(exit_when_done=True)
    error = served.exception(DEADLINE)
    assert isinstance(error, RefusedError)
    assert re.search("your moon is full.* wait a week", str(error))


def test_a_run_whose_task_a_later_version_describes_is_refused(stage):
    hand = stage.hand()
    hand.spec = OfTomorrow(**vars(hand.spec))
    _, served = stage.worker(exit_when_done=True)
    assert isinstance(served.exception(DEADLINE), RefusedError)


@pytest.mark.parametrize(
    ("task", "refusal", "why"),
    [
        (tasks.TOY, ("your moon is full", "wait a week"), "your moon is full"),
        ("os:abort", None, "'os:abort'"),  # which it did not announce
    ],
)
def test_with_any_a_run_that_refuses_or_cannot_be_scored_is_skipped(stage, said, cached, task, refusal, why):
    picky = stage.hand(task, run="picky")
    picky.refusal = refusal
    other = stage.also(picky, run="second")
    other.slots = 1
    stage.worker(run=None, any=True)
    assert re.search(r"\b15\b", wait_for(said, why))
    other.ready()


def test_a_name_is_its_identity_in_the_run(stage, cached):
    hand = stage.hand()
    stage.worker(name="hostB")
    assert hand.hello().worker.startswith("hostB/")


def test_an_invalid_name_is_refused():
    with pytest.raises(UsageError, match="'big host'"):
        WorkerConfig(name="big host")


def test_a_task_that_is_given_and_cannot_be_loaded_is_an_error_at_once():
    with pytest.raises(UsageError, match=r"'tests\.support\.tasks:Moon'"):
        Worker(WorkerConfig(), Network(), ("tests.support.tasks:Moon",))


def foreign(tmp_path, monkeypatch):
    """A module that writes a file when it is imported, and that file."""
    mark = tmp_path / "imported"
    (tmp_path / "foreign_world.py").write_text(
        f"open({str(mark)!r}, 'w').close()\ndef World():\n    raise SystemExit\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    return mark


@pytest.mark.parametrize("task", ["foreign_world:World", "gym:foreign_world:X-v0"])
def test_a_task_that_it_did_not_announce_is_never_imported(stage, cached, tmp_path, monkeypatch, task):
    mark = foreign(tmp_path, monkeypatch)
    stage.hand(task)
    _, served = stage.worker(exit_when_done=True)
    assert isinstance(error := served.exception(DEADLINE), RefusedError)
    assert re.search(rf"--task\W+{re.escape(task)}", str(error))
    assert not mark.exists()


@pytest.mark.parametrize("task", ["foreign_world:World", "gym:foreign_world:X-v0"])
def test_a_child_imports_no_task_that_its_worker_did_not_announce(tmp_path, monkeypatch, task):
    mark, events = foreign(tmp_path, monkeypatch), queue.SimpleQueue()
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    slot = Slot(0, ScorerArguments(TaskSpec(task, "", 100, 0), None, (tasks.TOY, "gym")), events)
    failure = events.get(timeout=DEADLINE)[1].failure
    assert failure.error.cause == "RefusedError"
    slot.stop()
    assert not mark.exists()


def test_a_world_model_of_an_unannounced_task_imports_nothing(stage, tmp_path, monkeypatch):
    mark, small = foreign(tmp_path, monkeypatch), stage.bundle
    parts = {name: small.read(name) for name in small.manifest.parts}
    world = replace(small.manifest, task="foreign_world:World", world=small.manifest.facts)
    stage.bundle = write_bundle(tmp_path / "foreign.zip", world, parts)
    stage.hand("dream")
    _, served = stage.worker(exit_when_done=True)
    assert isinstance(served.exception(DEADLINE), RefusedError)
    assert not mark.exists()


def test_it_sends_its_host_class_once_a_child_has_determined_it(stage, cached):
    hand = stage.hand()
    stage.worker()
    assert hand.hello().host_class == ""
    beat = hand.beat(lambda beat: beat.capacity > 0)
    assert len(beat.host_class) == 16
    hand.send(1, hand.job())
    assert hand.next(ResultBatch).host_class == beat.host_class
    hand.vanish()
    hand.nonce = SECOND
    hand.appear()
    assert hand.hello().host_class == beat.host_class
