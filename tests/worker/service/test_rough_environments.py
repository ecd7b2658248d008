"""Slots whose environments fork, crash, hang, or raise what nobody expects.
Tests common/host/child.py, common/host/descendants.py and slot.py."""

import os
import queue
import signal
from contextlib import suppress
from time import monotonic, sleep

import pytest
from msgspec.structs import replace

from dreamfleet import DreamfleetError, TaskSpec
from dreamfleet.worker.scoring.failure_cause import crash
from dreamfleet.worker.service.child import ScorerArguments
from dreamfleet.worker.service.job_group import MOST_TRIED_SINGLY
from dreamfleet.worker.service.slot_budget import SharedSlots
from dreamfleet.worker.service.slot_pool import SlotPool
from tests.support import rough_tasks, tasks
from tests.support.processes import DEADLINE, runs
from tests.support.samples import VECTOR, job

pytestmark = pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="Linux")


@pytest.fixture
def left(tmp_path, monkeypatch):
    """The ids of the processes that the environment leaves behind."""
    folder = tmp_path / "left"
    folder.mkdir()
    monkeypatch.setenv(rough_tasks.FOLDER, str(folder))
    yield folder
    for each in folder.iterdir():
        if int(each.name):
            with suppress(ProcessLookupError):
                os.kill(int(each.name), signal.SIGKILL)


def wait_gone(folder):
    until = monotonic() + DEADLINE
    for each in folder.iterdir():
        while runs(int(each.name)):
            assert monotonic() < until, f"process {each.name} still runs"
            sleep(0.01)


@pytest.mark.parametrize("task", ["Forking", "ForkingBySystemCall", "Daemonizing", "Executing"])
def test_a_crash_is_noticed_although_another_process_holds_the_pipe_and_that_ends_too(harness, left, task):
    slot = harness(f"{rough_tasks.MODULE}:{task}")
    assert slot.score().error == crash(-signal.SIGSEGV)
    assert len(list(left.iterdir())) == 1
    wait_gone(left)
    slot.wait_ready()


def test_what_a_child_left_behind_ends_with_it_when_it_hangs_and_when_its_slot_is_stopped(harness, left):
    slot = harness(f"{rough_tasks.MODULE}:ForkingAndHanging")
    assert slot.score(stall=1.0).error.kind == "crash"
    wait_gone(left)
    slot.wait_ready()
    for each in left.iterdir():
        each.unlink()
    slot.submit(0)
    while not list(left.iterdir()):
        sleep(0.01)
    slot.slot.stop()
    wait_gone(left)


@pytest.mark.parametrize(
    ("task", "cause"),
    [
        ("rough_tasks:Exiting", "exit status 0"),
        ("rough_tasks:Deaf", " 1"),
        ("rough_tasks:Rubbish", " 1"),
        pytest.param("tasks:Silent", "", marks=pytest.mark.slow),  # it lives, but closed its pipe
    ],
)
def test_a_childs_end_is_its_jobs_error_and_it_is_replaced(harness, task, cause):
    slot = harness(f"tests.support.{task}").wait_ready()
    pid = slot.slot.pid
    found = slot.score(stall=0.0 if task.endswith("Silent") else 1.0).error
    assert (found.kind, cause in found.cause, runs(pid)) == ("crash", True, False)
    slot.wait_ready()


@pytest.mark.parametrize("poison", rough_tasks.POISONS)
def test_a_poisoned_child_fails_no_job(harness, monkeypatch, poison):
    monkeypatch.setenv(rough_tasks.POISON, poison)
    slot = harness(f"{rough_tasks.MODULE}:Poisoned")
    assert slot.score(0).fitness is not None
    pid = slot.slot.pid
    assert slot.score(1, stall=1.0).fitness is not None
    assert slot.slot.pid != pid


def test_only_the_failed_jobs_of_a_group_are_repeated_and_before_what_waited(harness):
    slot = harness(f"{rough_tasks.MODULE}:PoisonedBatch")
    assert slot.score(0).fitness is not None
    jobs = [job(number, spec=slot.spec) for number in range(1, 6)]
    digests = [each.digest for each in jobs]
    for group in (jobs[:3], jobs[3:]):
        slot.slot.submit([(each, VECTOR) for each in group])
    assert [(each.digest, each.fitness) for each in slot.results()] == [(digest, 1.0) for digest in digests[:2]]
    assert not slot.slot.ready
    assert slot.slot.running == jobs[2:3]
    assert slot.slot.waiting == jobs[3:]
    assert slot.slot.wanted_digests == set(digests[2:])
    for digest in digests[2:]:
        assert [(each.digest, each.fitness) for each in slot.results()] == [(digest, 1.0)]


def test_a_failed_job_that_is_not_wanted_is_not_repeated(harness):
    slot = harness(f"{rough_tasks.MODULE}:PoisonedBatch")
    assert slot.score(0).fitness is not None
    jobs = slot.submit_group(range(1, 3))
    slot.slot.abandon(jobs[1].digest)
    assert [each.digest for each in slot.results()] == [jobs[0].digest]
    assert slot.slot.running == []
    assert slot.score(3).fitness is not None


def test_the_failures_of_a_fresh_childs_first_large_group_are_reported_at_once(harness):
    slot = harness(tasks.EXPLODING).wait_ready()
    pid = slot.slot.pid
    slot.submit_group(range(MOST_TRIED_SINGLY + 1))
    assert [each.fitness for each in slot.results()] == [None] * (MOST_TRIED_SINGLY + 1)
    assert slot.slot.pid == pid


@pytest.mark.slow
def test_the_jobs_of_a_small_group_that_failed_are_tried_one_by_one(harness):
    slot = harness(tasks.EXPLODING).wait_ready()
    jobs = slot.submit_group(range(3))
    for each in jobs:
        assert [(result.digest, result.fitness) for result in slot.results()] == [(each.digest, None)]


def test_a_job_that_crashes_its_process_takes_no_other_with_it(harness):
    slot = harness(f"{rough_tasks.MODULE}:OneCrashes").wait_ready()
    jobs = slot.submit_group(range(4))
    found = {}
    while len(found) < len(jobs):
        found |= {result.digest: result.fitness is not None for result in slot.results()}
    assert found == {each.digest: each.seeds[0] != rough_tasks.DEADLY for each in jobs}


@pytest.mark.slow
def test_a_group_that_is_sent_again_without_its_unwanted_jobs_can_still_be_abandoned(harness):
    slot = harness(tasks.SLOW_TOY)
    assert slot.score(99).fitness is not None
    jobs = slot.submit_group(range(MOST_TRIED_SINGLY + 4))
    slot.slot.abandon(jobs[0].digest)
    os.kill(slot.slot.pid, signal.SIGKILL)
    while slot.slot.ready:
        slot.take()
    slot.wait_ready()
    assert slot.slot.running == jobs[1:]
    for each in jobs:
        slot.slot.abandon(each.digest)
    while slot.slot.running:
        assert slot.take() == ()


@pytest.mark.slow
def test_the_episodes_of_a_group_may_begin_one_after_the_other_without_counting_as_hung(harness):
    slot = harness(f"{rough_tasks.MODULE}:SlowToBegin").wait_ready()
    pid = slot.slot.pid
    slot.slot.submit([(replace(job(number, spec=slot.spec), stall=2.0), VECTOR) for number in range(4)])
    assert all(each.fitness is not None for each in slot.results())
    assert slot.slot.pid == pid


def test_a_copy_of_the_child_does_not_answer(harness, left):
    slot = harness(f"{rough_tasks.MODULE}:Twice")
    for number in range(3):
        assert slot.score(number).fitness is not None


def test_an_environment_may_start_and_end_processes_of_its_own(harness):
    assert harness(f"{rough_tasks.MODULE}:Parallel").score(stall=60.0).fitness is not None


@pytest.mark.slow
def test_a_suspended_child_with_a_full_pipe_does_not_block_its_worker(harness, monkeypatch):
    monkeypatch.setattr("dreamfleet.worker.service.child_process.SEND_LIMIT", 1)
    slot = harness(tasks.TOY).wait_ready()
    os.kill(slot.slot.pid, signal.SIGSTOP)
    assert slot.score(vector=bytes(4 << 20)).error.kind == "crash"
    slot.wait_ready()


@pytest.mark.slow
def test_a_child_that_cannot_end_is_left_behind(harness, monkeypatch):
    slot = harness(f"{rough_tasks.MODULE}:Deaf").wait_ready()
    monkeypatch.setattr(slot.slot._child, "kill", lambda: None)  # as one in a system call that does not return
    pid = slot.slot.pid
    assert slot.score(stall=1.0).error.kind == "crash"
    assert runs(pid)
    os.kill(pid, signal.SIGKILL)
    slot.wait_ready()


@pytest.mark.slow
@pytest.mark.parametrize(("place", "error"), [("make", "SystemExit"), ("policy", "Mute")])
def test_whatever_is_raised_as_a_slot_starts_is_one_clear_error(harness, monkeypatch, place, error):
    monkeypatch.setenv(rough_tasks.PLACE, place)
    monkeypatch.setenv(rough_tasks.ERROR, error)
    with pytest.raises(DreamfleetError, match=error):
        harness(f"{rough_tasks.MODULE}:Raising").wait_ready()


@pytest.mark.slow
def test_many_children_that_cannot_end_do_not_delay_the_end_of_a_pool(random_bundle, monkeypatch):
    spec = TaskSpec(task=tasks.TOY, bundle=random_bundle.sha256, horizon=1, patience=0)
    arguments = ScorerArguments(spec, random_bundle.path, (tasks.TOY,))
    pool = SlotPool(SharedSlots(3).open(1.0, lambda: None), arguments, queue.SimpleQueue(), 0)
    kills = [slot._child.kill for slot in pool._slots]
    for slot in pool._slots:
        monkeypatch.setattr(slot._child, "kill", lambda: None)
    began = monotonic()
    pool.stop()
    taken = monotonic() - began
    for kill in kills:
        kill()
    assert taken < 4.5
