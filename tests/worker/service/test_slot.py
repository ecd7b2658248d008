"""Slots, and scoring a group of jobs without a child process.
Tests child.py, child_process.py, failure_log.py, job_group.py, slot.py, common/host/parent_death.py and
common/host/stall_watch.py."""

import hashlib
import io
import os
import re
import resource
import select
import shutil
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path
from time import monotonic

import numpy as np
import pytest
from msgspec.structs import replace

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.worker.scoring.failure_cause import crash
from dreamfleet.worker.service.failure_log import MAX_KINDS, MAX_TRACE, FailureLog, ScoringFailure
from dreamfleet.worker.service.job_group import AbandonedError, score_group
from dreamfleet.worker.service.slot import FAILED_STARTS, MAX_START_DELAY, START_LIMIT, STARVED_STARTS
from dreamfleet.worker.tasks.api import Score
from tests.support import tasks
from tests.support.bundles import write_random_bundle
from tests.support.failures import failure
from tests.support.processes import environment, started
from tests.support.rough_tasks import ERRORS
from tests.support.samples import SPEC, VECTOR, job
from tests.support.slot_harness import hash_of

OUT_OF_MEMORY = crash(-signal.SIGKILL)


def test_the_same_job_gives_the_same_bits_and_a_collected_rollout_is_the_drive_of_the_candidate(harness):
    slot = harness(tasks.TOY)
    scored, other = slot.score(), slot.score(1)
    assert scored.fitness != other.fitness
    files = []
    for _ in range(2):
        slot.submit(0, kind="collect")
        kept, file = slot.outcome()
        files.append(file)
        assert (kept.fitness, kept.steps) == (scored.fitness, scored.steps) == (scored.fitness, 10)
        assert kept.upload == hashlib.sha256(file).digest()
    assert files[0] == files[1], "equal drives give equal files"
    with np.load(io.BytesIO(file), allow_pickle=False) as drive:
        assert drive["reward"].sum() == pytest.approx(scored.fitness, rel=1e-5)
        assert (len(drive["picture"]), bool(drive["ended"])) == (10, True)


@pytest.mark.slow
def test_an_exception_in_a_fresh_child_is_the_jobs_error(harness):
    slot = harness(tasks.RAISING).wait_ready()
    pids = [slot.slot.pid]
    slot.submit(0, kind="collect")
    failed, file = slot.outcome()
    assert (failed.fitness, failed.upload, file) == (None, None, None)
    for _ in range(3):
        pids.append(slot.slot.pid)
        result = slot.score()
        assert (result.fitness, result.error.cause) == (None, "RuntimeError")
    assert pids[0] == pids[1], "a failure in a fresh child replaces no child"
    assert len(set(pids)) == 3


def test_nobody_reads_from_a_slot_that_was_stopped(harness):
    slot = harness(tasks.TOY)
    before = threading.active_count()
    slot.score()
    slot.slot.stop()
    assert threading.active_count() == before - 1


def test_after_short_groups_the_next_one_is_queued_in_the_child_if_its_vectors_fit_in_the_pipe(harness):
    slot = harness(tasks.TOY).wait_ready()
    assert not slot.slot.can_queue_another
    slot.score()
    for number in (1, 2):
        slot.submit(number)
        assert slot.slot.can_queue_another == (number == 1)
    assert [each.digest for each in slot.slot.waiting] == [job(2, spec=slot.spec).digest]
    assert [slot.result().digest for _ in range(2)] == [job(number, spec=slot.spec).digest for number in (1, 2)]
    assert slot.score(3, vector=bytes(60_000)).fitness is not None
    slot.submit(4)
    assert not slot.slot.can_queue_another


def test_a_group_ends_without_a_result_when_all_its_jobs_are_abandoned_and_the_child_lives_on(harness):
    slot = harness(tasks.SLOW_TOY).wait_ready()
    pid, jobs = slot.slot.pid, slot.submit_group(range(2))
    slot.slot.abandon(jobs[0].digest)
    assert [each.digest for each in slot.results()] == [each.digest for each in jobs]
    slot.slot.submit([(each, VECTOR) for each in jobs])
    for each in jobs:
        slot.slot.abandon(each.digest)
    while slot.slot.running:
        assert slot.take() == ()
    assert slot.score(2).fitness is not None
    assert slot.slot.pid == pid


def test_a_hung_job_is_killed_and_its_child_replaced(harness):
    slot = harness(tasks.HANGING).wait_ready()
    stalling = replace(job(0, spec=slot.spec), stall=5.0)
    slot.slot.submit([(stalling, VECTOR)])
    now = monotonic()
    slot.slot.check(now + 4.0, 0.0)
    slot.slot.check(now + 8.0, 4.0)  # the host was suspended for four of the eight seconds
    assert slot.slot.running
    slot.slot.check(now + 9.5, 0.0)
    result = slot.result()
    assert (result.fitness, result.error.kind) == (None, "crash")
    slot.wait_ready()


def test_a_child_over_its_memory_limit_is_replaced_between_jobs(harness):
    slot = harness(tasks.TOY, memory_limit=1).wait_ready()
    pid = slot.slot.pid
    assert slot.score().fitness is not None
    assert not slot.slot.ready
    assert slot.score(1).fitness is not None
    assert slot.slot.pid != pid


def test_a_child_that_cannot_start_ends_with_its_reason(harness, tmp_path):
    broken = tmp_path / "broken.zip"
    broken.write_bytes(b"no bundle")
    slot = harness(tasks.TOY, broken)
    for _ in range(FAILED_STARTS - 1):
        slot.slot.handle(slot.gone())
        slot.slot.check(monotonic() + MAX_START_DELAY, 0.0)
    last = slot.gone()
    with pytest.raises(DreamfleetError, match=r"broken\.zip"):
        slot.slot.handle(last)


def test_a_child_that_hangs_as_it_starts_is_replaced_and_the_next_one_has_more_time(harness):
    slot = harness(tasks.TOY)
    pid, now = slot.slot.pid, monotonic()
    os.kill(pid, signal.SIGSTOP)
    slot.slot.check(now + START_LIMIT - 1.0, 0.0)
    slot.slot.check(now + 2 * START_LIMIT, START_LIMIT)  # the host was suspended for that time
    slot.slot.check(now + 2 * START_LIMIT + 2.0, 0.0)
    slot.slot.handle(slot.gone())
    second = slot.slot.pid
    slot.slot.check(monotonic() + 2 * START_LIMIT - 2.0, 0.0)
    assert slot.score().fitness is not None
    assert slot.slot.pid == second != pid


@contextmanager
def without_descriptors():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_slot_retries_without_descriptors_and_then_names_the_cause(harness, random_bundle):
    hash_of(random_bundle.path)
    with without_descriptors():
        slot = harness(tasks.TOY)
        for _ in range(FAILED_STARTS - 2):
            slot.pass_time()
        assert slot.slot.pid == 0
    slot.pass_time()
    assert slot.score().fitness is not None
    with without_descriptors():
        slot.lose()
        for _ in range(STARVED_STARTS - 2):
            slot.pass_time()
        with pytest.raises(DreamfleetError, match="--slots"):
            slot.pass_time()


def test_children_that_end_without_a_result_are_replaced_after_growing_pauses(harness):
    slot = harness(tasks.TOY)
    for number in range(4):
        slot.wait_ready()
        slot.lose()
        assert (slot.slot.pid == 0) == (number > 0)
        slot.slot.check(monotonic() + 0.4 * 2 ** (number - 1), 0.0)
        assert (slot.slot.pid == 0) == (number > 0)
        slot.slot.check(monotonic() + MAX_START_DELAY, 0.0)
    assert slot.score().fitness is not None


def kill_as_it_starts(slot, times):
    """Have so many starts fail as the kernel does when memory is short; the pauses after them."""
    pauses = []
    for _ in range(times):
        slot.pass_time()
        slot.lose()
        pauses.append(slot.slot._start_at - monotonic())
    return pauses


def test_a_short_host_is_tried_for_ten_minutes(harness):
    slot = harness(tasks.TOY)
    with pytest.raises(DreamfleetError, match=OUT_OF_MEMORY.text):
        kill_as_it_starts(slot, FAILED_STARTS)  # it was never ready
    slot = harness(tasks.TOY)
    assert slot.score().fitness is not None
    slot.lose()
    pauses = kill_as_it_starts(slot, STARVED_STARTS - 1)
    assert pauses == pytest.approx([2, 4, 8, 16, 32, *[60] * 9], abs=1.0)
    slot.pass_time()
    assert slot.score().fitness is not None
    slot.lose()
    kill_as_it_starts(slot, STARVED_STARTS - 1)
    with pytest.raises(DreamfleetError, match=OUT_OF_MEMORY.text):
        kill_as_it_starts(slot, 1)


@pytest.mark.slow
def test_a_child_that_ends_as_it_starts_blames_no_job_and_a_host_that_stays_short_gives_its_jobs_back(harness):
    slot = harness(tasks.SLOW_TOY).wait_ready()
    for number in (0, 2):
        slot.submit(number, number + 1)
        os.kill(slot.slot.pid, signal.SIGKILL)
        assert slot.result().error == OUT_OF_MEMORY
        if number == 0:
            os.kill(slot.slot.pid, signal.SIGKILL)  # the next child, which is starting and has the second job
            scored = slot.result()
            assert (scored.digest, scored.error) == (job(1, spec=slot.spec).digest, None)
            slot.lose()
            slot.wait_ready()  # a fresh child again, whose crash is its job's error
    kill_as_it_starts(slot, FAILED_STARTS - 1)
    assert [each.digest for each in slot.slot.running] == [job(3, spec=slot.spec).digest]
    kill_as_it_starts(slot, 1)
    assert slot.slot.running == []
    slot.pass_time()
    assert slot.score(4).fitness is not None


def test_signals_for_the_worker_do_not_end_a_starting_child(harness):
    slot = harness(tasks.TOY)
    pid = slot.slot.pid
    for number in (signal.SIGINT, signal.SIGTERM):
        os.kill(pid, number)
    assert slot.score().fitness is not None
    assert slot.slot.pid == pid


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="Linux")
def test_a_child_dies_with_its_worker(random_bundle, tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(
        "import pathlib, sys\n"
        "from tests.support import tasks\n"
        "from tests.support.slot_harness import Harness\n"
        "if __name__ == '__main__':\n"
        "    slot = Harness(tasks.HANGING, pathlib.Path(sys.argv[1]))\n"
        "    slot.wait_ready()\n"
        "    slot.submit(0)\n"
        "    print(slot.slot.pid, flush=True)\n"
        "    slot.events.get()\n"
    )
    command = [sys.executable, script, random_bundle.path]
    with started(command, env=environment(tmp_path), stdout=subprocess.PIPE, text=True) as parent:
        pid = int(parent.stdout.readline())
        child = os.pidfd_open(pid)
        assert not select.select([child], [], [], 0)[0]
        parent.kill()
        died = bool(select.select([child], [], [], 10)[0])
        if not died:
            os.kill(pid, signal.SIGKILL)
        os.close(child)
        assert died, "it hangs in its job, where no closed pipe ends it"


def test_a_bundle_that_was_swapped_is_never_scored_with(harness, random_bundle, tmp_path):
    path = tmp_path / "cached.zip"
    shutil.copyfile(random_bundle.path, path)
    slot = harness(tasks.TOY, path)
    slot.score()
    write_random_bundle(tmp_path / "other.zip", seed=1).path.replace(path)
    slot.lose()  # another child starts
    with pytest.raises(DreamfleetError, match=r"cached\.zip"):
        slot.wait_ready()


@pytest.mark.parametrize("damage", [Path.unlink, lambda path: path.write_bytes(b"no bundle")])
def test_a_removed_or_damaged_bundle_is_fetched_again(harness, random_bundle, tmp_path, damage):
    path = tmp_path / "cached.zip"
    shutil.copyfile(random_bundle.path, path)
    slot = harness(tasks.TOY, path, restore_bundle=lambda: shutil.copyfile(random_bundle.path, path))
    before = slot.score()
    damage(path)
    slot.lose()
    assert slot.score().fitness == before.fitness


WORK = [(job(number), VECTOR) for number in range(3)]


class Scorer:
    def __init__(self, *scores):
        self._scores = scores

    spec = SPEC

    def score_all(self, episodes, on_step, spec):
        assert all(np.array_equal(vector, np.frombuffer(VECTOR, "<f4")) for _, vector, _ in episodes)
        assert spec == SPEC
        for number, _ in enumerate(self._scores):
            on_step(number + 1)
        return list(self._scores)


def score(*scores, count=lambda _made: None):
    return score_group(Scorer(*scores), 5, WORK, count)


def test_each_job_has_its_own_result_in_plain_numbers_and_an_equal_share_of_the_time():
    done = score(*(Score(np.float32(number), np.int64(10 + number)) for number in range(3)))
    assert (done.group, done.upload, done.failure) == (5, None, None)
    assert [(each.digest, each.fitness, each.steps) for each in done.results] == [
        (job(number).digest, float(number), 10 + number) for number in range(3)
    ]
    assert {(type(each.fitness), type(each.steps)) for each in done.results} == {(float, int)}
    assert len({each.seconds for each in done.results}) == 1


@pytest.mark.parametrize(
    ("scores", "said"), [([Score(1.0, 1)], r"\b1\b.*\b3\b"), ([Score(1.0, 1)] * 2 + [None], "AttributeError")]
)
def test_invalid_scores_are_the_tasks_error(scores, said):
    done = score(*scores)
    assert [each.fitness for each in done.results] == [None] * 3
    assert all(re.search(said, each.error.text) for each in done.results)
    assert re.search(said, done.failure.trace)


@pytest.mark.parametrize("number", [float("nan"), float("inf"), 1e300])
def test_a_fitness_that_is_no_number_is_the_error_of_its_job_alone(number):
    done = score(Score(1.0, 1), Score(number, 1), Score(2.0, 1))
    assert [each.fitness for each in done.results] == [1.0, None, 2.0]
    assert done.results[1].error is not None
    assert done.failure is None


def test_an_abandoned_group_has_no_results_and_no_failure():
    def count(made):
        if made == 2:
            raise AbandonedError

    done = score(*[Score(1.0, 1)] * 3, count=count)
    assert (done.results, done.failure) == ((), None)


@pytest.mark.parametrize("error", ERRORS)
def test_whatever_is_raised_is_each_jobs_error_and_the_steps_before_it_are_divided(error):
    class Failing(Scorer):
        def score_all(self, episodes, on_step, spec):
            on_step(9)
            raise ERRORS[error]()

    done = score_group(Failing(), 5, WORK, lambda _made: None)
    assert [each.steps for each in done.results] == [3, 3, 3]
    cause_and_kind = ("host", "host") if error in ("MemoryError", "OSError") else (error, "other")
    assert (done.failure.error.cause, done.failure.error.kind) == cause_and_kind
    assert error in done.failure.error.text
    assert "\n" not in done.failure.error.text
    assert done.results == tuple(replace(each, error=done.failure.error) for each in done.results)


def raised(error, depth=0):
    """The failure of an error that is raised in this line, or, with a depth, in the one above."""
    try:
        if depth:
            raise error
        raise error
    except Exception as caught:
        return ScoringFailure.of(caught)


def test_a_failure_is_logged_with_its_task_its_first_job_and_its_traceback():
    found = raised(RuntimeError("the road has ended"))
    logged = [FailureLog().format_if_new(found, "moon", [job(row) for row in range(jobs)]) for jobs in range(4)]
    first, *trace = logged[1].splitlines()
    assert re.search("moon.*RuntimeError: the road has ended .*candidate 7/2, seed 1048576", first)
    assert "Traceback" in trace[0]
    assert trace[-1] == "RuntimeError: the road has ended"
    assert re.search(r"seed 1048576.* 2\b", logged[3])
    assert "seed" not in logged[0].splitlines()[0]


def test_each_kind_is_logged_once():
    failures = FailureLog()
    cases = (ValueError("lap 1"), 0, True), (ValueError("lap 2"), 0, False), (KeyError("1"), 0, True)
    for error, depth, is_new in (*cases, (ValueError("lap 2"), 1, True)):
        assert bool(failures.format_if_new(raised(error, depth), "moon", [job()])) == is_new


def test_the_log_is_bounded():
    failures = FailureLog()
    kinds = [ScoringFailure(failure("text"), str(kind), "trace") for kind in range(2 * MAX_KINDS)]
    assert sum(failures.format_if_new(kind, "moon", []) is not None for kind in kinds) == MAX_KINDS
    assert len(raised(RuntimeError("x" * 100_000)).trace) == MAX_TRACE


def test_an_error_that_cannot_be_encoded_is_replaced():
    failure = raised(OSError("no file \udcff\nsecond line"))
    assert failure.error.text == r"OSError: no file \udcff"
    assert failure.trace.encode()
    assert raised(RuntimeError("")).error.text.startswith(f"RuntimeError: {Path(__file__).name}:")
