"""Results and checks that a journal takes back, and which of them count again."""

import pytest

from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.messages import Result
from dreamfleet.common.runs.records import StoredEvaluation
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.seeds import CHOOSING_OFFSET, validation_seeds
from dreamfleet.coordinator.jobs.evaluation import Evaluation
from dreamfleet.coordinator.jobs.generation import Generation
from dreamfleet.coordinator.jobs.scoring_job import make_jobs
from dreamfleet.coordinator.storage.journal import Journal
from tests.support.run_bench import SETTINGS
from tests.support.samples import SPEC

VECTORS = [bytes(20), bytes([1]) * 20]
SEEDS = (1, 2)


@pytest.fixture
def journal(tmp_path, random_bundle):
    """Two generations whose results are all of host a, and checked by host b."""
    made = Journal.create(tmp_path / "run", SETTINGS, random_bundle.path)
    made.begin_incarnation()
    for number in (0, 1):
        made.open_generation(number, b"state", 0.1, SEEDS, VECTORS)
        for work in jobs_of(number):
            made.results.add(work.job, Result(work.digest, 1.0, 10, 0.1, None, None), "a/1", "f", 1, "class")
            made.verification.add(work.job, "a/1", "b", "equal")
    made.commit()
    yield made
    made.close()


def jobs_of(number):
    return Generation(number, SPEC, [bytes([number]) + vector[1:] for vector in VECTORS], SEEDS).work


def unverified(journal, number):
    return set(journal.verification.unverified([work.job for work in jobs_of(number)]))


def digests_of(number):
    return {work.digest for work in jobs_of(number)}


def test_a_check_does_not_stand_again_by_the_word_of_a_host_that_was_barred(journal):
    journal.recalls.rewind(0, b"state", SEEDS)
    journal.recalls.recall({"b"})
    journal.open_generation(1, b"state", 0.1, SEEDS, VECTORS)
    journal.recalls.count_again(jobs_of(1))
    assert set(journal.results.of("score", 1)) == digests_of(1), "what a brought counts again"
    assert unverified(journal, 0) == digests_of(0)
    assert unverified(journal, 1) == digests_of(1)
    journal.verification.unbar("b")
    journal.recalls.rewind(0, b"state", SEEDS)
    journal.recalls.count_again(jobs_of(1))
    assert unverified(journal, 1) == digests_of(1), "nor once it may come again"


def test_a_check_stands_again_by_the_word_of_a_host_that_was_not_barred(journal):
    journal.recalls.rewind(0, b"state", SEEDS)
    journal.open_generation(1, b"state", 0.1, SEEDS, VECTORS)
    journal.recalls.count_again(jobs_of(1))
    assert not unverified(journal, 0)
    assert not unverified(journal, 1)


def test_what_a_dropped_evaluation_had_counts_for_an_earlier_one_of_the_same_mean(journal):
    last, first = (Evaluation(number, VECTORS[0], 3) for number in (1, 0))
    seeds = {}
    for job in (each.job for each in last.work(SPEC)):
        seeds[job.seeds[0]] = float(job.episode)
        journal.results.add(job, Result(job.digest, float(job.episode), 10, 0.1, None, None), "a/1", "f", 1, "class")
        journal.verification.add(job, "a/1", "b", "equal")
    journal.schedule_evaluation(last)
    journal.recalls.rewind(0, b"state", SEEDS)
    journal.schedule_evaluation(first)
    assert len(journal.fitness_of("evaluate", first.work(SPEC))) == 3
    journal.finish_evaluation(0, StoredEvaluation(0, 3, 1.0, 0.8), 0)
    journal.commit()
    with RunFolder(journal.path.parent) as run:
        run.verify()
        assert run.scores(0) == seeds
    journal.recalls.recall({"b"})
    assert journal.pending_evaluations() == [first], "its checks are of its generation, too"


def test_a_recall_begins_where_a_host_alone_confirmed_what_others_brought(journal):
    assert journal.recalls.first_brought({"a"}) == journal.recalls.first_brought({"b"}) == {"score": 0}
    journal.recalls.recall({"b"})
    assert journal.recalls.first_brought({"b"}) == {}, "its word is gone"
    for work in jobs_of(1):
        journal.verification.add(work.job, "a/1", "c", "equal")
    assert journal.recalls.first_brought({"c"}) == {"score": 1}
    assert journal.recalls.first_brought({"d"}) == {}


def test_an_evaluation_of_which_a_barred_host_alone_confirmed_a_part_is_finished_again(journal):
    for number, checker in enumerate("bc"):
        evaluation = Evaluation(number, VECTORS[number], 1)
        journal.schedule_evaluation(evaluation)
        (work,) = evaluation.work(SPEC)
        journal.results.add(work.job, Result(work.digest, 1.0, 10, 0.1, None, None), "a/1", "f", 1, "class")
        journal.verification.add(work.job, "a/1", checker, "equal")
        journal.finish_evaluation(number, StoredEvaluation(number, 1, 1.0, 0.0), 0)
    journal.recalls.recall({"b"})
    assert [each.generation for each in journal.pending_evaluations()] == [0]


def test_who_only_confirmed_the_report_decided_about_no_candidate_and_no_evaluation(journal):
    journal.schedule_evaluation(Evaluation(0, VECTORS[0], 1))
    seeds = validation_seeds(2, CHOOSING_OFFSET)
    scored, failed = (each.job for each in make_jobs(SPEC, "evaluate", 0, 0, VECTORS[0], seeds, first=CHOOSING_OFFSET))
    journal.results.add(scored, Result(scored.digest, 1.0, 10, 0.1, None, None), "c/1", "f", 1, "class")
    journal.verification.add(scored, "c/1", "d", "equal")
    journal.add_failure(failed, Failure("no score", ""), ["e/1"], 1)
    journal.finish_evaluation(0, StoredEvaluation(0, 1, 1.0, 0.0), 0)
    for host in "dec":
        assert journal.recalls.first_brought({host}) == {"confirm": 0}
        journal.recalls.recall({host})
        assert not journal.pending_evaluations()
    assert not journal.read("SELECT 1 FROM failure UNION SELECT 1 FROM result WHERE kind = 'evaluate'")


@pytest.mark.parametrize(("barred", "stands"), [("b", True), ("c", True), ("bc", True), ("b c", False)])
def test_a_check_of_several_hosts_stands_while_one_of_them_is_believed(journal, barred, stands):
    (work, *_) = jobs_of(0)
    journal.write("UPDATE verification SET checker = 'b,c', outcome = 'differs' WHERE digest = ?", work.digest)
    for host in barred.split():
        journal.recalls.recall({host})
    assert (work.digest not in unverified(journal, 0)) == stands


def test_what_a_closed_race_did_not_want_is_aside_and_counts_again_if_its_generation_opens_again(journal):
    steps, work = journal.results.effort.steps, jobs_of(1)
    surplus, *others = [each.digest for each in work]
    journal.recalls.set_surplus_aside(1, [surplus])
    assert set(journal.results.of("score", 1)) == set(others)
    assert journal.results.effort.steps == steps - 10
    journal.recalls.count_again(work[:1])
    assert surplus not in journal.results.of("score", 1), "its generation is closed"
    journal.recalls.rewind(1, b"state", SEEDS)
    assert set(journal.results.of("score", 1)) == {surplus, *others}
    assert journal.results.effort.steps == steps
    assert not unverified(journal, 1)


def test_what_a_race_of_a_dropped_generation_did_not_want_counts_again_when_its_job_is_wanted(journal):
    surplus, *others = [work.digest for work in jobs_of(1)]
    journal.recalls.set_surplus_aside(1, [surplus])
    journal.recalls.rewind(0, b"state", SEEDS)
    journal.recalls.count_again(jobs_of(1))
    assert set(journal.results.of("score", 1)) == {surplus, *others}


def test_what_a_race_did_not_want_of_a_barred_host_never_counts_again(journal):
    surplus, *_ = [work.digest for work in jobs_of(1)]
    journal.recalls.set_surplus_aside(1, [surplus])
    journal.recalls.recall({"a"})
    journal.recalls.rewind(1, b"state", SEEDS)
    assert not journal.results.of("score", 1)
    assert journal.verification.counts()["recalled"] == 8
