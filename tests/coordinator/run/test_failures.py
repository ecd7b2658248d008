"""Candidates whose episodes fail wherever they are scored.

Tests failure_policy.py, common/protocol/failures.py and coordinator/dispatch/failure_judge.py.
"""

import itertools
import json
import sqlite3
from contextlib import closing
from dataclasses import replace

import pytest

from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.stop_kind import PauseKind
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.seeds import CONFIRMING_OFFSET, training_seed
from dreamfleet.coordinator.jobs import generation
from dreamfleet.coordinator.run.recall import recall
from dreamfleet.coordinator.run.run import BY_HAND
from dreamfleet.coordinator.run.shown_state import shown_state
from dreamfleet.coordinator.settings.limits import LimitsConfig
from tests.support.dispatched import result
from tests.support.failing_runs import GENERATIONS, SETTINGS, Failing, by_vector, pause_kinds
from tests.support.failures import failure
from tests.support.run_bench import A, B

NEW = "new/1"


def failed(bench):
    """How many candidates failed in each generation of a run, which has ended."""
    assert bench.run.state.ended
    return [each.failed for each in bench.run.history.rows]


def break_others(bench):
    """Every host but a fails whatever it is given from now on."""
    answer, error = bench.answer_one, failure("OSError", "sick")
    bench.answer_one = lambda name, job: (
        answer(name, job) if name == A else bench.deliver(name, result(job.digest, error=error, steps=0))
    )


def killed(bench, results):
    """The bench's story if its coordinator is killed each time that so many results and errors have come."""
    while not bench.run.state.ended:
        bench.serve(stop=lambda run: run.fleet.counts["accepted"] + run.fleet.counts["errors"] > results)
        if not bench.run.state.ended:
            bench.restart()
    return bench.story()


def test_a_failed_candidate_ranks_last_and_the_run_ends(failing):
    bench = failing(fails=by_vector(0.15))
    rows, candidates, *_ = bench.story()
    unscored = [each for each in candidates if each[0] < GENERATIONS and each[2] is None]
    assert 0 < len(unscored) == sum(failed(bench))
    with RunFolder(bench.path) as folder:
        facts = folder.failures()
    assert {(each.generation, each.candidate) for each in facts} == {each[:2] for each in unscored}
    assert all(each.attempts == 2 and set(each.workers.split(",")) == {A, B} for each in facts)
    assert len(rows) == GENERATIONS
    assert all(row.worst <= row.mean <= row.best for row in rows)


@pytest.mark.parametrize("on_failure", ["worst", "redraw"])
def test_the_bits_are_the_same_on_any_fleet_and_through_restarts(failing, begin, on_failure):
    settings = replace(SETTINGS, on_failure=on_failure, evaluate_every=1, evaluation_episodes=3, confirm_episodes=4)

    def fails(job):
        return (job.vector[0] + job.seeds[0]) % 256 < 40

    whole = failing(settings=settings, fails=fails, limit=1.0).story()
    assert sum(each.failed for each in whole[0])
    lone = begin(fails, settings, limit=1.0, hosts=[A])
    lone.serve()
    assert lone.story() == whole
    assert killed(begin(fails, settings, limit=1.0), 12) == whole


def test_a_run_whose_every_episode_fails_pauses_and_resume_tries_again(begin):
    bench = begin(lambda job: True)
    bench.serve()
    assert pause_kinds(bench) == [PauseKind.NO_ABLE_HOST]
    bench.fails = lambda job: False
    bench.run.resume()
    bench.serve()
    assert failed(bench) == [0] * GENERATIONS


def test_more_failures_than_the_limit_pause_the_run_and_resume_scores_these_candidates_again(begin):
    bench = begin(lambda job: job.candidate > 1)
    bench.serve()
    assert (pause_kinds(bench), len(bench.run.generation.failed)) == ([PauseKind.FAILED_CANDIDATES], 4)
    bench.fails = lambda job: job.candidate > 3
    bench.run.resume()
    bench.serve()
    assert failed(bench) == [2, 2, 2]


def test_all_candidates_failing_is_a_pause_that_says_so_whatever_the_limit(begin):
    bench = begin(lambda job: job.candidate >= 0, limit=1.0)
    bench.run.fleet.failure_judge.working_hosts = {"a", "b"}
    bench.serve()
    assert (pause_kinds(bench), bench.run.generation.all_failed) == ([PauseKind.FAILED_CANDIDATES], True)
    bench.fails = lambda job: False
    bench.run.resume()
    bench.serve()
    assert bench.run.state.ended


def test_one_generation_with_many_failures_does_not_pause_a_run_that_had_few(failing):
    bench = failing(fails=lambda job: job.kind == "score" and job.generation == 2 and job.candidate > 1)
    assert failed(bench) == [0, 0, 4]


def test_after_resume_the_same_failures_do_not_pause_the_generation_again(begin):
    bench = begin(lambda job: job.candidate > 1 - job.generation)
    bench.serve()
    assert (pause_kinds(bench), bench.run.generation.number) == ([PauseKind.FAILED_CANDIDATES], 0)
    bench.run.resume()
    bench.serve()
    assert (pause_kinds(bench), bench.run.generation.number) == ([PauseKind.FAILED_CANDIDATES], 1)
    assert bench.run.history.rows[0].failed == 4


@pytest.mark.parametrize("on_failure", ["worst", "redraw"])
def test_a_seed_on_which_all_candidates_fail_is_replaced_with_the_same_bits_through_restarts(
    failing, begin, on_failure
):
    settings = replace(SETTINGS, on_failure=on_failure)
    bad = {training_seed(settings.seed, 1, each) for each in (0, 1, 3)}  # so it takes two other sets of seeds

    def fails(job):
        return job.seeds[0] in bad

    bench = failing(settings=settings, fails=fails)
    whole = bench.story()
    assert failed(bench) == [0, 0, 0], "what fails on a seed on which all fail is not the candidate's"
    (seeds,) = bench.journal._connection.execute("SELECT seeds FROM generation WHERE number = 1").fetchone()
    assert json.loads(seeds) == [training_seed(settings.seed, 1, each) for each in (4, 5)]
    assert killed(begin(fails, settings), 26) == whole


def test_a_bad_seed_of_the_first_generation_is_replaced_before_the_limit_counts(failing):
    bad = training_seed(SETTINGS.seed, 0, 0)
    bench = failing(fails=lambda job: job.seeds[0] == bad)
    assert failed(bench) == [0, 0, 0]


def test_seeds_on_which_the_whole_better_half_fails_are_replaced_in_a_race(failing):
    settings = replace(SETTINGS, racing=True, episodes=4, population=8)
    bad = training_seed(settings.seed, 1, 2)  # of the second half
    bench = failing(settings=settings, fails=lambda job: job.seeds[0] == bad)
    assert failed(bench) == [0, 0, 0]
    (seeds,) = bench.journal._connection.execute("SELECT seeds FROM generation WHERE number = 1").fetchone()
    assert json.loads(seeds) == [training_seed(settings.seed, 1, each) for each in (4, 5, 6, 7)]


def test_redraws_count_each_candidate_once_and_go_on_where_all_failed(begin):
    settings = replace(SETTINGS, on_failure="redraw")
    first = []

    def fails(job):
        first.append(job.digest) if len(first) < 12 and job.digest not in first else None
        return job.digest in first

    bench = begin(fails, settings, limit=1.0)
    bench.run.fleet.failure_judge.working_hosts = {"a", "b"}
    bench.serve()
    assert bench.run.state.ended
    assert bench.run.history.rows[0].failed <= 6


def test_a_host_that_never_scored_condemns_nobody(begin):
    bench = begin()
    break_others(bench)
    bench.serve()
    assert failed(bench) == [0] * GENERATIONS


@pytest.fixture
def left(begin):
    """A run whose only host is gone; all open jobs failed on it once."""
    bench = begin(lambda job: job.candidate < 2, hosts=[A])
    answer = bench.answer_one
    bench.answer_one = lambda name, job: bench.run.fleet.jobs[job.digest].attempts or answer(name, job)
    bench.serve(stop=lambda run: len(run.fleet.jobs.failures) == len(run.fleet.jobs) == 4)
    bench.answer_one = answer
    bench.run.fleet.handle_departure(A, bench.now)
    return bench


def replace_host(bench):
    bench.wait()
    bench.hosts = [NEW]
    bench.admit(NEW)
    bench.serve()


def test_a_run_without_hosts_waits_for_them_though_every_open_job_failed(left):
    for _ in range(3):
        left.run.advance(left.now)
        assert left.run.state.paused is None
        left.wait()
    assert shown_state(left.run).word == "waiting for workers"


def test_a_new_host_proves_itself_on_a_job_that_was_scored_before(left):
    """Only jobs that fail are open when it comes: nothing else would show that it can score."""
    replace_host(left)
    assert failed(left) == [2] * GENERATIONS
    assert left.run.fleet.counts["duplicate"] == 1


def test_a_failing_job_goes_to_the_host_where_it_failed_least(left):
    """A new host that joins before the one that has scored gets no control job: both are here, and one is known."""
    left.wait()
    left.hosts = [NEW, A]
    left.admit(NEW, A)
    left.serve()
    assert failed(left) == [2] * GENERATIONS


def test_a_new_host_that_fails_the_control_job_pauses_the_run(left):
    left.fails = lambda job: True
    replace_host(left)
    assert pause_kinds(left) == [PauseKind.NO_ABLE_HOST]
    assert left.run.generation.failed == []


def test_a_host_that_has_scored_ends_the_pause_of_a_fleet_that_cannot(left):
    sound = left.fails
    left.fails = lambda job: True
    replace_host(left)
    assert left.run.state.paused.until_host
    left.fails = sound
    break_others(left)
    left.hosts = [NEW, A]
    left.admit(A)
    left.handle_heartbeat(A)
    left.run.advance(left.now)
    assert left.run.state.paused is None
    left.serve()
    assert failed(left) == [2] * GENERATIONS


def test_a_run_that_nobody_can_score_pauses_before_every_job_was_tried(begin):
    settings = replace(SETTINGS, population=40)
    for limit, tried in ((0.5, 10), (1.0, 80)):
        bench = begin(lambda job: True, settings, limit=limit)
        bench.serve()
        assert pause_kinds(bench) == [PauseKind.NO_ABLE_HOST]
        assert (len(bench.run.fleet.jobs.failures) < 80) == (tried < 80)
        assert sum(each.what == "retried" for each in bench.run.take_notes()) == 1


def test_a_shortage_of_the_host_is_no_failure_of_the_candidate(failing):
    whole = failing(fails=lambda job: False).story()
    short = failing(fails=lambda job: False, host_errors=[Failure.of_host("killed by SIGKILL")] * 9)
    assert short.story() == whole
    assert short.run.fleet.counts["errors"] == 9


def test_an_evaluation_counts_its_scored_episodes_and_one_without_any_ends(failing):
    settings = replace(SETTINGS, evaluate_every=1, evaluation_episodes=3, confirm_episodes=4)
    partly = failing(settings=settings, fails=lambda job: job.kind == "evaluate" and job.episode % 3 == 0)
    _, _, _, evaluations, confirmed = partly.story()
    assert [(each.episodes, each.failed) for each in evaluations] == [(2, 1)] * GENERATIONS
    assert confirmed.episodes + confirmed.failed == 4
    assert confirmed.failed
    none = failing(settings=settings, fails=lambda job: job.kind == "evaluate", limit=1.0)
    assert none.run.state.ended
    assert none.story()[3:] == ([], None)
    late = failing(settings=settings, fails=lambda job: job.episode >= CONFIRMING_OFFSET)
    assert late.run.state.ended
    with RunFolder(late.path) as folder:
        assert folder.confirmation() is None


def test_time_without_workers_or_paused_is_no_time_of_the_run(begin):
    bench = begin()
    bench.run.limits = LimitsConfig(minutes=1.0)
    bench.run.pause(BY_HAND)
    for _ in range(100):
        bench.wait()
        bench.run.commit()
    assert bench.run.open_seconds == 0.0
    bench.run.resume()
    for name in (A, B):
        bench.handle_heartbeat(name)
    bench.wait()
    assert bench.run.open_seconds == 1.0
    bench.hosts = []
    for name in (A, B):
        bench.run.fleet.handle_departure(name, bench.now)
    for _ in range(100):
        bench.wait()
    assert bench.run.open_seconds <= 2.0
    bench.run.leave()
    bench.hosts = [A, B]
    spent = bench.run.open_seconds
    bench.restart()
    assert bench.run.open_seconds == pytest.approx(spent), "the open generation's time outlives its coordinator"


def test_a_pause_by_hand_outlives_its_coordinator(begin):
    bench = begin()
    bench.journal.set_busy_timeout(0.05)
    with closing(sqlite3.connect(bench.path / "journal.sqlite")) as other:
        other.execute("BEGIN IMMEDIATE")
        bench.run.pause(BY_HAND)
        bench.run.keep_paused()
        assert bench.run.state.stalled
    bench.wait(10.0)
    assert bench.run.commit()
    bench.restart()
    assert bench.run.state.paused.pauses == (BY_HAND,)
    bench.run.resume()
    bench.run.commit()
    bench.restart()
    bench.serve()
    assert bench.run.state.ended


class Lethal(Failing):
    """A bench whose workers end without a word on the jobs of `fails`; another life of each joins after that.

    With `new_names` it comes on a host of another name, as in a cloud.
    """

    new_names = False

    def begin(self):
        self.lives = itertools.count(16)
        super().begin()

    def handle_heartbeat(self, name):
        super().handle_heartbeat(name)
        if not self.new_names:  # else each new host ends the pause
            self.run.advance(self.now)  # as the service does: the run sees the new life before it gets jobs

    def answer_one(self, name, job):
        if name not in self.hosts:  # it ended on a job before
            return
        if self.fails(job):
            self.run.fleet.handle_departure(name, self.now)
            number = next(self.lives)
            life = f"pod{number}/{number:08x}" if self.new_names else f"{name.partition('/')[0]}/{number:08x}"
            self.hosts[self.hosts.index(name)] = life
            self.admit(life)
        else:
            super().answer_one(name, job)


@pytest.mark.parametrize("new_names", [False, True])
def test_an_episode_that_ends_its_worker_counts_as_failed_and_its_company_does_not(begin, new_names):
    bench = begin(lambda job: job.candidate == 3, kind=Lethal)
    bench.new_names = new_names
    bench.serve(turns=3000)
    assert failed(bench) == [1] * GENERATIONS
    with RunFolder(bench.path) as folder:
        facts = folder.failures()
    assert {each.candidate for each in facts} == {3}


@pytest.mark.parametrize("has_scored", [False, True])
def test_fifty_kills_on_one_host_pause_only_a_run_that_it_never_scored(begin, has_scored):
    """Ten jobs that fail before the first score pause it: it says how many, and what ends the pause."""
    settings = replace(SETTINGS, population=16)
    bench = begin(settings=settings, kind=Lethal, hosts=[A])
    if has_scored:
        bench.serve(stop=lambda run: run.fleet.counts["accepted"] > 3)
    kills = iter(range(50))
    bench.fails = lambda job: next(kills, None) is not None
    bench.serve(turns=3000)
    if not has_scored:
        (pause,) = bench.run.state.paused.pauses
        assert (pause.kind, pause.until_host) == (PauseKind.NO_ABLE_HOST, True)
        assert len(bench.run.fleet.jobs.failures) == 10
        assert {"10", "32"} <= set(pause.text.split())
        assert all(each in pause.text for each in ("`dreamfleet resume`", "`dmesg`"))
        bench.fails = lambda job: False
        bench.run.resume()
        bench.serve()
    assert failed(bench) == [0] * GENERATIONS


def test_a_run_whose_every_episode_ends_its_worker_pauses(begin):
    bench = begin(lambda job: True, kind=Lethal)
    bench.new_names = True
    bench.serve(turns=3000)
    assert pause_kinds(bench) == [PauseKind.NO_ABLE_HOST]


def test_a_cut_link_is_no_end_of_a_worker(begin):
    """A worker of the same life that is back was never gone: nothing that it held is a suspect."""
    bench = begin(hosts=[A])
    for _ in range(20):
        bench.wait()
        bench.run.fleet.dispatch(bench.now)
        bench.run.fleet.handle_departure(A, bench.now)
        bench.wait()
        assert any(each.lost_with for each in bench.run.fleet.jobs.values())
        bench.admit(A)
        bench.handle_heartbeat(A)
        assert not any(each.lost_with for each in bench.run.fleet.jobs.values())
    bench.serve()
    assert failed(bench) == [0] * GENERATIONS


def test_a_host_that_replaces_its_scoring_process_counts_as_here(begin):
    """Its heartbeats name no capacity meanwhile."""
    bench = begin(lambda job: job.candidate == 0, hosts=[A])
    bench.serve(stop=lambda run: run.generation.done >= 10 or run.fleet.jobs.failures)
    bench.run.fleet.members[A].capacity = 0
    bench.run.advance(bench.now)
    assert bench.run.state.paused is None
    worked = bench.run.open_seconds
    bench.wait()
    assert bench.run.open_seconds > worked


@pytest.mark.parametrize("on_failure", ["worst", "pause"])
@pytest.mark.parametrize("is_broken", [False, True])
def test_a_run_ends_though_a_suspect_failed_on_the_only_host_that_has_scored(begin, on_failure, is_broken):
    """Another host has scored nothing: it gets a job that was scored before, and the suspect does not wait for it."""
    settings = replace(SETTINGS, on_failure=on_failure)
    bench = begin(settings=settings, hosts=[A])
    answer, tried = bench.answer_one, set()
    for each in bench.run.fleet.jobs.values():
        each.lost_with += ("x/1", "y/2") if each.work.job.candidate == 3 else ()

    def answer_one(name, job):
        is_first = job.candidate == 3 and job.generation == 0 and job.digest not in tried
        if is_first or (is_broken and name == B):
            tried.add(job.digest)
            bench.deliver(name, result(job.digest, error=failure("OSError", f"on {name}"), steps=0))
        else:
            answer(name, job)

    bench.answer_one = answer_one
    bench.serve(stop=lambda run: run.fleet.jobs.failures)
    bench.hosts = [A, B]
    bench.admit(B)
    bench.serve()
    assert failed(bench) == [0] * GENERATIONS


def test_a_resume_in_the_second_half_of_a_race_wants_the_first_half_before(begin):
    racing = replace(SETTINGS, racing=True, population=4)
    bench = begin(lambda job: job.candidate == 0, racing, limit=1.0)
    bench.serve(stop=lambda run: any(each.work.episode == 1 for each in run.fleet.jobs.values()))
    bench.run.pause(BY_HAND)
    bench.run.resume()  # it forgets the failures, so the better half is not known
    assert [(each.work.template.candidate, each.work.episode) for each in bench.run.fleet.jobs.values()] == [(0, 0)]


class Quiet(Failing):
    """A bench in which all answers of a turn arrive before the run goes on."""

    deliver = Failing.send


def test_where_all_that_was_made_has_failed_the_rest_of_the_generation_goes_on(begin, monkeypatch):
    stories = []
    for part in (10_000, 1):
        monkeypatch.setattr(generation, "PART_JOBS", part)
        bench = begin(lambda job: job.candidate < 3, kind=Quiet, limit=1.0)
        bench.serve()
        stories.append(bench.story())
    assert stories[0] == stories[1]


# R8: only suspects are open, and no scored job is left that could show whether a new host can score.


def serve_alone(bench, name, until):
    """Let one host score until a generation is open; the other is gone."""
    for other in [each for each in bench.run.fleet.members if each != name]:
        bench.run.fleet.remove_worker(other)
    bench.hosts = [name]
    bench.admit(name)
    bench.serve(stop=lambda run: run.generation.number == until)


@pytest.fixture
def unproven(begin):
    """The host of generation 0 lost two workers with all jobs of generation 1, whose former scores were recalled."""
    settings = replace(SETTINGS, population=2, episodes=1)
    bench = begin(settings=settings)
    serve_alone(bench, A, 1)
    serve_alone(bench, B, 2)
    recall(bench.journal, settings, {"b"})
    bench.journal.commit()
    bench.restart()
    bench.run.fleet.remove_worker(B)
    for life in (A, "a/00000009"):
        bench.admit(life)
        bench.handle_heartbeat(life)
        assert len(bench.fetch()) == 2
        bench.run.fleet.handle_departure(life, bench.now)
        bench.wait()
        bench.run.advance(bench.now)
    assert all(each.is_suspect for each in bench.run.fleet.jobs.values())
    bench.hosts = [NEW]
    bench.admit(NEW)
    return bench


def test_a_new_host_gets_the_suspects_when_the_only_host_that_has_scored_is_gone_and_pauses_if_it_fails_all(unproven):
    unproven.fails = lambda job: True
    unproven.serve()
    assert pause_kinds(unproven) == [PauseKind.NO_ABLE_HOST]
    assert unproven.run.generation.failed == []
    unproven.fails = lambda job: False
    unproven.run.resume()
    unproven.serve()
    assert failed(unproven) == [0, 0, 0]
