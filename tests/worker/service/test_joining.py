"""How a worker joins a run: it waits, is welcomed or is refused; when and how it leaves.
Tests admission.py, config.py, worker.py, bundle_fetch.py and worker/tasks/registry.py."""

import json
import os
import queue
import re
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import chain, repeat
from time import monotonic
from unittest.mock import Mock

import pytest

from dreamfleet.common.artifacts.bundle import write_bundle
from dreamfleet.common.errors import AccessError, ConnectionFailedError, RefusedError, UsageError
from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES, fingerprint
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import encode_json
from dreamfleet.common.protocol.messages import ResultBatch, TaskSpec
from dreamfleet.common.security.credentials import Credentials
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.worker.service import membership, worker
from dreamfleet.worker.service.admission import find_run_with_fewest_slots
from dreamfleet.worker.service.child import ScorerArguments
from dreamfleet.worker.service.config import WorkerConfig
from dreamfleet.worker.service.slot import Slot
from dreamfleet.worker.service.worker import Worker
from tests.support import samples, tasks
from tests.support.hand import DEADLINE, SECOND, SLOW_BEATS, Hand, unknown_sender
from tests.support.processes import free_port
from tests.support.stage import drained, wait_for


@dataclass(frozen=True)
class OfTomorrow(TaskSpec):
    later: float = 0.5


@pytest.mark.slow
def test_it_waits_for_a_coordinator_that_starts_later_and_until_its_run_is_there(stage, said, cached):
    stage.worker()
    wait_for(said, f"tcp/127.0.0.1:{stage.port}")
    other = stage.hand(run="another")
    wait_for(said, "run test")
    assert stage.also(other).ready().slots == 1


def test_a_slot_that_can_score_is_reported_at_once(stage, cached):
    hand = stage.hand()
    hand.intervals = SLOW_BEATS
    stage.worker()
    hand.hello()
    began = monotonic()
    assert [hand.beat().capacity, hand.beat().capacity] == [0, 1]
    assert monotonic() - began < SLOW_BEATS.beat, "it waited for the next beat"


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


def test_it_says_hello_again_with_its_name_and_the_packages_of_the_runs_fingerprint(stage, cached):
    hand = stage.hand()
    hand.packages = ("numpy", "no-such-package")
    stage.worker(name="hostB")
    first, second = hand.hello(), hand.hello()
    assert (first.packages, second.packages) == (NUMERIC_PACKAGES, hand.packages)
    assert first.worker == second.worker
    assert first.worker.startswith("hostB/")
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
    hand = stage.hand()
    refusal = replace(samples.JSON["hello-reply"], run="test", accepted=False, why="go away", remedy="far away")
    with unknown_sender(hand, "dreamfleet/**", lambda _: encode_json(refusal)):
        stage.worker()
        assert hand.ready().slots == 1


def test_a_refusal_or_a_task_that_a_later_version_describes_ends_a_worker_with_exit_when_done(stage):
    hand = stage.hand()
    hand.refusal = ("your moon is full", "wait a week")
    assert isinstance(error := stage.error(), RefusedError)
    assert re.search("your moon is full.* wait a week", str(error))
    hand.refusal, hand.spec = None, OfTomorrow(**vars(hand.spec))
    assert isinstance(stage.error(), RefusedError)


@pytest.mark.slow
def test_it_asks_again_for_a_bundle_that_arrived_damaged(stage, said):
    hand = stage.hand()
    hand.damage = lambda offset, data: data[::-1]
    stage.worker()
    for _ in range(4):  # three times, and that it asks again
        wait_for(said, hand.spec.bundle[:12])
    hand.damage = lambda offset, data: data
    assert hand.ready().slots == 1


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


def test_settings_that_no_worker_can_have_are_an_error_at_once():
    with pytest.raises(UsageError, match="'big host'"):
        WorkerConfig(name="big host")
    with pytest.raises(UsageError, match=r"--runs.*64"):
        WorkerConfig(any=True, runs=0)
    with pytest.raises(UsageError, match=r"'tests\.support\.tasks:Moon'"):
        Worker(WorkerConfig(), Network(), ("tests.support.tasks:Moon",))


@pytest.fixture
def mark(tmp_path, monkeypatch):
    """A file that a module writes when it is imported."""
    mark = tmp_path / "imported"
    (tmp_path / "foreign_world.py").write_text(
        f"open({str(mark)!r}, 'w').close()\ndef World():\n    raise SystemExit\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    return mark


@pytest.mark.parametrize("task", ["foreign_world:World", "gym:foreign_world:X-v0"])
def test_neither_a_worker_nor_its_child_imports_a_task_that_it_did_not_announce(stage, cached, mark, task):
    stage.hand(task)
    assert isinstance(error := stage.error(), RefusedError)
    assert re.search(rf"--task\W+{re.escape(task)}", str(error))
    events = queue.SimpleQueue()
    slot = Slot(0, ScorerArguments(TaskSpec(task, "", 100, 0), None, (tasks.TOY, "gym")), events)
    assert events.get(timeout=DEADLINE)[1].failure.error.cause == "RefusedError"
    slot.stop()
    assert not mark.exists()


def test_a_world_model_of_an_unannounced_task_imports_nothing(stage, tmp_path, mark):
    small = stage.bundle
    parts = {name: small.read(name) for name in small.manifest.parts}
    world = replace(small.manifest, task="foreign_world:World")
    stage.bundle = write_bundle(tmp_path / "foreign.zip", world, parts)
    stage.hand("dream")
    assert isinstance(stage.error(), RefusedError)
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


ODD = [
    *({"slots": slots} for slots in ("1e999", "1" + 400 * "0", "NaN", "[]")),
    {"share": "NaN"},
    *({"run": json.dumps(name)} for name in ("", "a#b", "*", "\ud800", ["odd"])),
]


def test_odd_statuses_of_other_runs_keep_no_worker_from_a_run():
    """A name that no key may contain raised where the run was asked."""
    good = {"state": '"running"', "run": '"good"', "slots": "3", "share": "1.0"}
    answers = [good, *({**good, "run": '"odd"', "slots": "400", **odd} for odd in ODD)]
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_session(Network(listen=(endpoint,))) as served, open_session(Network(connect=(endpoint,))) as session:
        for number, fields in reversed(list(enumerate(answers))):
            said = "{" + ", ".join(f'"{field}": {value}' for field, value in fields.items()) + "}"
            key = keys.status(f"run{number}")
            served.declare_queryable(key, lambda query, said=said: query.reply(query.key_expr, said))
        while (found := find_run_with_fewest_slots(session)) is None:
            pass  # the declarations are on their way
        assert found == "good"


@pytest.mark.parametrize("stopped", [False, True])
def test_it_leaves_and_says_why_when_it_is_stopped_or_its_coordinator_ends_the_run(stage, cached, stopped):
    hand, made, served = stage.served(tasks.SLOW_TOY, exit_when_done=not stopped)
    if stopped:
        made.stop()
    else:
        hand.send(1, hand.job())
        hand.beat(lambda beat: beat.running)
        hand.send(0, vectors=(), ended=True)
    hand.beat(lambda beat: beat.reason)
    assert served.result(DEADLINE) is None


@pytest.mark.parametrize("joined", [False, True])
def test_with_exit_when_done_it_fails_after_long_without_a_coordinator_and_says_what_is_lost(stage, cached, joined):
    hand = stage.hand()
    if not joined:
        hand.vanish()
    _, served = stage.worker(exit_when_done=True, coordinator_timeout=0.5)
    hand.hello()
    if joined:
        hand.beat(lambda beat: beat.capacity > 0)
        hand.send(1, hand.job())
        hand.result(hand.job())
        hand.vanish()
    error = served.exception(DEADLINE)
    assert isinstance(error, ConnectionFailedError)
    assert ("1 finished result" in str(error)) == joined
    assert "--coordinator-timeout" in str(error)


@pytest.mark.parametrize("listens", [False, True])
def test_with_exit_when_done_it_also_ends_where_no_coordinator_ever_let_it_in(listens):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = WorkerConfig(slots=1, exit_when_done=True, coordinator_timeout=0.1)
    router = open_session(Network(listen=(endpoint,))) if listens else nullcontext()
    with router, pytest.raises(ConnectionFailedError, match=r"--coordinator-timeout"):
        Worker(config, Network(connect=(endpoint,))).serve()


def test_a_worker_that_a_secured_router_shows_nothing_says_so_once(stage, said, cached, monkeypatch):
    monkeypatch.setattr(membership, "SEARCH_INTERVAL", 0.05)
    hand, made, _ = stage.served()
    object.__setattr__(made._link, "secured", True)  # frozen; a hand answers only hellos of an open fleet
    hand.vanish()
    wait_for(said, "shut out")
    hand.appear()
    hand.vanish()
    wait_for(said, "shut out")


def test_it_says_why_it_fails_before_it_can_score(stage):
    hand = stage.hand()
    hand.total = lambda: 1 << 60
    error, said = stage.error(), hand.beat()
    assert (said.capacity, said.reason) == (0, str(error))


def test_stopped_once_it_finishes_running_jobs_and_delivers_and_all_others_go_back(stage, cached):
    hand, made, served = stage.served(tasks.SLOW_TOY)
    running, queued, late = (hand.job(number) for number in range(3))
    hand.send(1, running, queued)
    hand.beat(lambda beat: beat.running)
    made.stop()
    assert hand.beat(lambda beat: beat.capacity == 0).queued == ()
    hand.send(2, late)
    assert hand.beat(lambda beat: beat.seen == 2).queued == ()
    assert hand.result(running).fitness is not None
    assert not served.done()
    hand.send(3, accepted=(running,))
    assert served.result(DEADLINE) is None


def test_stopped_once_it_abandons_a_download(stage):
    hand = stage.hand()
    hand.damage = lambda offset, data: None
    made, served = stage.worker()
    hand.offsets.get(timeout=DEADLINE)
    made.stop()
    assert served.result(2) is None


@pytest.mark.parametrize("coordinator", [False, True])
def test_its_lifetime_ends_without_a_run_too(stage, coordinator):
    if coordinator:
        stage.hand(run="another")
    _, served = stage.worker(lifetime=0.5)
    assert served.result(DEADLINE) is None


def test_a_worker_whose_host_slept_past_the_end_of_its_join_file_leaves(stage, monkeypatch):
    left = chain([timedelta(days=2)] * 3, repeat(timedelta(days=-1)))
    monkeypatch.setattr(Credentials, "time_left", property(lambda _: next(left)))
    monkeypatch.setattr(worker, "open_session", Mock(side_effect=ConnectionFailedError))
    credentials = Credentials("worker", 1, "first", datetime.now(UTC), ca="")
    network = Network(connect=(f"tls/127.0.0.1:{free_port()}",), credentials=credentials)
    assert isinstance(stage.worker(network=network)[1].exception(DEADLINE), AccessError)


def test_late_events_of_the_last_runs_slots_do_not_reach_the_next_run(stage, said, cached, monkeypatch):
    monkeypatch.setattr(membership, "NEXT_RUN_AFTER", 0.3)
    hand = stage.hand(run="one")
    hand.slots = 0
    stage.worker(run=None, any=True)
    hand.ready()
    other = stage.also(hand, run="two")
    hand.vanish()
    hand.slots = 1  # as if another worker served it; the next run has no slots
    other.ready()
    other.send(1, other.job())
    assert other.result(other.job()).fitness is not None
    assert not [line for line in drained(said) if "starting another" in line]


@pytest.mark.slow
def test_without_a_flag_it_says_why_its_run_ended_and_waits_for_it(stage, said, cached):
    hand, _, served = stage.served(tasks.SLOW_TOY)
    hand.answer_no_hello()  # as a run that has ended
    hand.send(0, vectors=(), ended=True, why="2 generations")
    assert hand.beat(lambda beat: beat.reason).reason.endswith("2 generations")
    hand.vanish()
    wait_for(said, hand.endpoint)
    stage.also(hand, tasks.SLOW_TOY).ready()
    assert not served.done()


@pytest.mark.slow
def test_a_worker_that_served_to_the_end_says_so_however_long_its_exit_takes():
    lingers = "import atexit, sys, time; atexit.register(time.sleep, 3600); from dreamfleet.__main__ import main; "
    words = ("worker", "--connect", f"tcp/127.0.0.1:{free_port()}", "--lifetime", "0.1")
    ended = subprocess.run([sys.executable, "-c", lingers + "sys.exit(main())", *words], check=False, timeout=DEADLINE)
    assert ended.returncode == 0
