"""A run with its worker protocol and its journal, without a transport. Tests background_jobs.py,
generations.py, report.py, stop_reason.py and common/protocol/stop_kind.py."""

import re
from dataclasses import replace
from math import inf, nan
from statistics import median
from time import process_time
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from dreamfleet.common.artifacts.objective import Objective
from dreamfleet.common.errors import ControllerError, UsageError
from dreamfleet.common.protocol.stop_kind import PauseKind, StopKind, StopReason
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.common.runs.records import StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.common.runs.run_provenance import read_run_provenance
from dreamfleet.coordinator.jobs.evaluation import Evaluation
from dreamfleet.coordinator.jobs.history import History
from dreamfleet.coordinator.jobs.rollout_collection import NOT_KEPT
from dreamfleet.coordinator.run.report import SAVE_INTERVAL
from dreamfleet.coordinator.run.stop_reason import find_stop_reason
from dreamfleet.coordinator.service.snapshot import take_snapshot
from dreamfleet.coordinator.service.status import encode_status
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.start import find_start
from tests.support.dispatched import result
from tests.support.failures import failure
from tests.support.run_bench import DRIVES, EVALUATED, SETTINGS, A, B, Bench, Reporting, drive_of, result_of
from tests.support.samples import SPEC


@pytest.fixture
def bench(make_bench):
    return make_bench(Bench)


def test_a_result_has_no_verdict_before_its_rollout_is_on_disk(bench):
    (name, job), _ = bench.reach_collection()
    bench.verdicts()
    bench.deliver(name, result_of(job))
    assert bench.verdicts() == []
    for part in bench.parts(job):
        bench.upload(name, part)
    assert bench.verdicts() == []
    bench.deliver(name, result_of(job))
    assert bench.verdicts() == [(name, job.digest, "accepted")]
    assert bench.kept() == [drive_of(job)]
    assert bench.run.background_jobs.rollout_collections.progress == (1, DRIVES)
    bench.deliver(name, result_of(job))
    assert bench.verdicts() == [(name, job.digest, "duplicate")]
    assert len(bench.run.background_jobs.rollout_collections.uploads) == 0


def test_upload_parts_of_a_job_that_was_not_given_are_dropped_and_counted(bench):
    (name, job), _ = bench.reach_collection()
    part = bench.parts(job)[0]
    for sender, each in (("x/0badc0de", part), (name, msgspec.structs.replace(part, digest=b"x" * 32))):
        bench.upload(sender, each)
    assert bench.run.dropped == {"unwanted upload": 2}
    assert len(bench.run.background_jobs.rollout_collections.uploads) == 0


def test_a_collected_rollout_without_its_upload_is_an_error(bench):
    (name, job), _ = bench.reach_collection()
    bench.verdicts()
    bench.deliver(name, msgspec.structs.replace(result_of(job), upload=None))
    assert {verdict for *_, verdict in bench.verdicts()} == {"refused"}
    assert bench.run.fleet.jobs.failures[0].attempts[0].error == NOT_KEPT


def test_a_pause_names_candidate_seed_every_worker_how_often_and_why(bench):
    job = dict(bench.fetch())[A]
    seed, name = job.seeds[0], f"candidate 0/{job.candidate}"
    for worker, error in ((A, "boom"), (B, "bang")):
        assert bench.run.state.paused is None
        bench.fetch()
        bench.deliver(worker, result(job.digest, error=failure(error)))
    (pause,) = bench.run.state.paused.pauses
    assert pause.kind is PauseKind.FAILED_JOB
    assert all(each in pause.text for each in (name, str(seed), A, B, "boom", "bang", "dreamfleet resume"))
    assert any(each.what == "paused" for each in bench.run.take_notes())


@pytest.mark.slow
def test_a_run_whose_population_is_one_point_ends_with_that_reason(make_bench):
    """With equal fitness the step size falls until the population is one point; later it would underflow."""
    settings = replace(SETTINGS, population=4, collect_every=0, sigma0=1e-30)
    bench = make_bench(Bench, settings, generations=0)
    while bench.run.state.ended is None:
        bench.score()
    closed = len(bench.run.history)
    bench.restart()
    assert (bench.run.state.ended.kind, len(bench.run.history)) == (StopKind.ONE_POINT, closed)
    with RunFolder(bench.path) as stored:
        assert stored.stop_kind is StopKind.ONE_POINT


def test_parted_compares_the_same_scores_before_and_after_a_restart(make_bench):
    """R28: it reads them from the journal. Equal means share their results, whichever generation asked for them."""
    settings = replace(SETTINGS, collect_every=0, evaluate_every=1, evaluation_episodes=4)
    bench = make_bench(Bench, settings, generations=3)
    while bench.run.state.ended is None:
        bench.score(lambda job: job.digest[0] / 10)

    def compared():
        jobs = bench.run.background_jobs
        return [jobs._evaluated_scores(each.generation) for each in jobs.evaluations.rows]

    before = compared()
    assert [len(each) for each in before] == [4, 4, 4]
    bench.journal.schedule_evaluation(Evaluation(9, bench.journal.evaluated_vector(1), 4))
    bench.journal.finish_evaluation(9, StoredEvaluation(9, 1, 1.0, 0.0), 0)
    bench.journal.commit()
    bench.restart()
    assert compared() == [*before, before[1]]
    with RunFolder(bench.path) as run:
        assert [run.scores(each.generation) for each in run.evaluations()] == [*before, before[1]]


def test_a_reached_limit_stays_reached_when_the_last_evaluation_contradicts_it(make_bench):
    """`--parted` reads the latest evaluations: the last one, which the end itself schedules, may be better again."""
    settings = replace(SETTINGS, collect_every=0, evaluate_every=1, evaluation_episodes=4, confirm_episodes=8)
    bench = make_bench(Bench, settings, generations=0)
    bench.limits = LimitsConfig(parted=1)
    bench.restart()
    level = {0: 9.0, 1: 1.0}

    def fitness(job):
        return job.digest[0] / 1000 + (level.get(job.generation, 9.0) if job.kind == "evaluate" else 0.0)

    while bench.journal.fact("ending") is None:
        bench.score(fitness)
    closed = len(bench.run.history)
    bench.restart()
    while bench.run.state.ended is None:
        bench.score(fitness)
    assert (bench.run.state.ended.kind, len(bench.run.history)) == (StopKind.PARTED, closed)


BLOCK, BLOCKS = 250, 400  # generations of a measurement, and how many there are


class LongRun(Bench):
    """A run whose workers answer at once; each generation is evaluated and its status encoded."""

    def cost(self):
        """Processor time of one more generation, in seconds."""
        begun, closed = process_time(), len(self.run.history)
        while len(self.run.history) == closed:
            self.now += 0.01
            for name in (A, B):
                self.handle_heartbeat(name)
            for send in self.run.fleet.dispatch(self.now):
                for work in send.work:
                    self.deliver(send.identity, result(work.digest, score(work)))
        encode_status(take_snapshot(self.run, "long", {}, self.now, self.now))
        self.run.take_notes()
        return process_time() - begun


def score(work):
    """The negative distance to a moving goal, so that the search never converges."""
    goal = np.cos(0.1 * work.job.generation)
    return -float(np.square(np.frombuffer(work.vector, "<f4") - goal).sum())


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_a_late_generation_costs_no_more_than_an_early_one(make_bench):
    run = make_bench(LongRun, replace(SETTINGS, population=4, evaluate_every=1, collect_every=0), generations=0)
    costs = [median(run.cost() for _ in range(BLOCK)) for _ in range(BLOCKS)]
    assert min(costs[-2:]) < 1.5 * min(costs[:2]), [round(1000 * cost, 2) for cost in costs]


@pytest.fixture
def make(make_bench):
    return lambda settings=EVALUATED, generations=100: make_bench(Reporting, settings, generations)


def test_a_mean_without_evaluation_is_saved_at_once_at_intervals_and_as_the_coordinator_leaves(make):
    bench = make(replace(EVALUATED, evaluate_every=0))
    assert bench.saved() is None
    bench.close(3)
    assert bench.saved().provenance["generation"] == 0, "that of the first closed one"
    bench.now += SAVE_INTERVAL
    bench.close(4)
    assert bench.saved().provenance["generation"] == 3
    bench.close(5)
    bench.run.leave()
    assert bench.saved().provenance["generation"] == 4


def test_after_every_evaluation_the_file_holds_the_best_evaluated_mean(make):
    bench = make()
    bench.close(2)
    named = ("generation", "confirmed", "validation_mean", "validation_episodes")
    assert [bench.saved().provenance[each] for each in named] == [1, False, 10.0, 2]
    bench.now += SAVE_INTERVAL
    bench.close(4)
    assert bench.saved().provenance["generation"] == 1
    bench.run.commit()
    vector = bench.journal.evaluated_vector(1)
    assert np.array_equal(bench.saved().parameters, np.frombuffer(vector, "<f4"))


def test_the_report_survives_a_restart(make):
    bench = make()
    bench.close(3)
    bench.run.leave()
    before = bench.saved()
    (bench.path / CONTROLLER).unlink()
    bench.restart()
    bench.run.leave()
    after = bench.saved()
    assert (after.sha256, after.provenance) == (before.sha256, before.provenance)


@pytest.mark.parametrize("every", [0, 2])
def test_a_run_that_resumes_beyond_its_limit_writes_the_controller_and_the_reason(make, every):
    bench = make(replace(EVALUATED, evaluate_every=every))
    bench.close(3)
    (bench.path / CONTROLLER).unlink()
    bench.limits = LimitsConfig(generations=2)
    bench.restart()
    assert bench.run.state.ended == StopReason(StopKind.GENERATIONS, "3 generations")
    assert bench.saved() is not None
    with RunFolder(bench.path) as stored:
        assert stored.ended == "3 generations"


def test_an_ended_runs_receipt_counts_its_last_evaluation_also_if_another_is_better(make):
    bench = make(replace(EVALUATED, confirm_episodes=0), generations=4)
    while bench.run.state.ended is None:
        bench.now += SAVE_INTERVAL  # so that it is saved as each generation closes
        bench.step()
    found = bench.saved()
    with RunFolder(bench.path) as stored:
        assert found.provenance["generation"] == 1
        assert (received := read_run_provenance(found)).generations == len(stored.history()) == 4
        assert received.effort == stored.total_effort()


def test_an_open_run_has_a_controller_once_a_generation_is_closed(make):
    bench = make()
    with pytest.raises(ControllerError, match=bench.path.name):
        find_controller(bench.path.name, bench.path.parent)
    bench.close(1)
    controller, beside = find_controller(bench.path.name, bench.path.parent)
    assert controller.sha256 == bench.run.background_jobs.report.current.controller().sha256
    assert beside is not None
    assert beside.exists()


def test_a_new_run_starts_from_the_mean_of_an_open_run_and_from_the_report_of_an_ended_one(make):
    bench = make()
    bench.close(3)
    opened = find_start(bench.path.name, bench.path.parent)
    assert opened.source.startswith("run ")
    bench.limits = LimitsConfig(generations=1)
    bench.restart()
    assert bench.run.state.ended is not None
    ended = find_start(bench.path.name, bench.path.parent)
    assert np.array_equal(ended.mean, bench.saved().parameters.astype(np.float64))
    assert not np.array_equal(opened.mean, ended.mean)


NO_JOBS = SimpleNamespace(evaluations=SimpleNamespace(best=None))
FALLEN = SimpleNamespace(
    evaluations=SimpleNamespace(best=StoredEvaluation(0, 10, 5.0, 1.0)), have_fallen_behind=lambda limit: limit == 2
)
OPEN = SimpleNamespace(is_one_point=False, number=9)


def find(limits, *best, task="gym:CartPole-v1", options="", spread=2.0, jobs=NO_JOBS, generation=OPEN):
    rows = (StoredGeneration(number, each, 1.0, each, each - spread, 0.1, 10, 1.0) for number, each in enumerate(best))
    return find_stop_reason(limits, History(rows), jobs, generation, replace(SPEC, task=task, options=options))


def reason(*given, **more):
    found = find(*given, **more)
    return found and found.text


@pytest.mark.parametrize(
    ("kind", "limits"),
    [
        (StopKind.GENERATIONS, {"generations": 4}),
        (StopKind.STEPS, {"steps": 40}),
        (StopKind.MINUTES, {"minutes": 4 / 60}),
        (StopKind.CANDIDATE_TARGET, {"candidate_target": 2.0}),
        (StopKind.STAGNATION, {"stagnation": 2}),
        (StopKind.TARGET, {"target": 5.0}),
        (StopKind.PARTED, {"parted": 2}),
        (StopKind.ONE_POINT, {}),
    ],
)
def test_each_end_has_its_kind(kind, limits):
    generation = SimpleNamespace(is_one_point=kind is StopKind.ONE_POINT, number=9)
    found = find(LimitsConfig(**limits), 2, 1, 1, 1, jobs=FALLEN, generation=generation)
    assert found.kind is kind
    assert StopKind.parse(found.kind.value) is kind
    assert StopKind.parse("of a later version") is None
    assert "--" not in found.text, "a search in Python says it too"


def test_a_run_ends_when_a_candidate_reaches_the_target():
    assert reason(LimitsConfig(candidate_target=3.0), 1, 2.9) is None
    assert "3.0" in reason(LimitsConfig(candidate_target=3.0), 1, 3, 2)
    assert reason(LimitsConfig(candidate_target=0.0), -1e-13, 0.0)


def test_a_run_ends_after_so_many_generations_without_a_better_candidate():
    limits = LimitsConfig(stagnation=3)
    assert reason(limits) is None
    assert reason(limits, 1, 2, 1, 2) is None
    assert re.search(r"\b1\b.*1e-11.*\b3\b", reason(limits, 1, 2, 1, 2, 2))
    assert reason(limits, 1, 2, 1, 2, 2.5) is None
    creeping = [1 + 1e-12 * number for number in range(20)]
    assert reason(limits, *creeping[:4]) is not None, "less than any use"
    assert reason(limits, *(1 + 4e-12 * number for number in range(20))) is None, "but many small steps count"
    small = [1e-14 * each for each in (1, 2, 1, 2, 2.1)]
    assert reason(limits, *small) is not None
    assert reason(limits, *small, spread=2e-14) is None, "of a function whose values differ by less than 1"


def test_of_a_function_evaluations_are_counted_and_a_minimised_target_is_named_by_its_value():
    options = Objective.of({"x0": [0.0], "minimise": True}).options
    task = {"task": "function:mine:cost", "options": options}
    assert reason(LimitsConfig(steps=20), 1, 2) != reason(LimitsConfig(steps=20), 1, 2, **task)
    assert re.search(r"\b0\.25", reason(LimitsConfig(candidate_target=-0.5), -2, -0.25, **task))


@pytest.mark.parametrize(
    ("flag", "wrong"), [("stagnation", -1), ("candidate-target", nan), ("target", nan), ("target", inf)]
)
def test_what_is_no_limit_is_refused(flag, wrong):
    with pytest.raises(UsageError, match=f"--{flag}"):
        LimitsConfig(**{flag.replace("-", "_"): wrong})
