"""What a run keeps, and the results and checks that it takes back, and which of them count again.
Tests file_watch.py, journal.py, journal_connection.py, journal_file.py, recall_records.py, result_records.py,
verification_records.py and common/runs/records.py."""

import os
import re
import shlex
import shutil
import subprocess
from functools import partial

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.errors import DamagedJournalError, JournalError, NotWritableNowError, UsageError
from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.messages import Result
from dreamfleet.common.runs.records import RunSettings, StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.common.runs.run_lock import run_lock
from dreamfleet.common.runs.run_paths import JOURNAL
from dreamfleet.common.runs.seeds import CHOOSING_OFFSET, validation_seeds
from dreamfleet.coordinator.jobs.confirmation import Finalist
from dreamfleet.coordinator.jobs.evaluation import Evaluation
from dreamfleet.coordinator.jobs.generation import Generation
from dreamfleet.coordinator.jobs.scoring_job import make_jobs, vector_bytes
from dreamfleet.coordinator.storage import file_watch
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.coordinator.storage.journal_file import sqlite_side_files
from dreamfleet.coordinator.storage.recall_records import REWOUND
from dreamfleet.coordinator.storage.verification_records import UNCHECKED
from tests.support.disks import read_only_view
from tests.support.journals import change_journal
from tests.support.samples import SPEC

SETTINGS = RunSettings(SPEC, ControllerShape(1, 3), 2, 1, 0.1, "diagonal", 1, 5, 2)
VECTORS = [vector_bytes(np.full(6, value)) for value in (0.5, 1.5)]


@pytest.fixture
def folder(tmp_path, random_bundle):
    path = tmp_path / "night"
    path.mkdir()
    Journal.create(path, SETTINGS, random_bundle.path).close()
    return path


@pytest.fixture
def journal(folder):
    opened = Journal(folder / "journal.sqlite")
    yield opened
    opened.close()


def fill(journal):
    """One generation, closed, and the next one opened."""
    journal.open_generation(0, b"state 0", 0.1, [7], VECTORS)
    generation = Generation(0, SPEC, VECTORS, [7])
    for value, work in enumerate(generation.work):
        result = Result(work.job.digest, float(value), 10, 0.5, None, None)
        journal.results.add(work.job, result, "w/00000000", "f", 1, "class")
    journal.close_generation(StoredGeneration(0, 0.5, 0.5, 1.0, 0.0, 0.1, 20, 1.0), np.array([0.0, 1.0]))
    journal.open_generation(1, b"state 1", 0.09, [8], VECTORS)
    journal.commit()


@pytest.mark.parametrize("candidate", [2, -1, 2**62])
def test_a_candidate_that_was_drawn_anew_and_does_not_exist_is_damage(journal, folder, candidate):
    fill(journal)
    change_journal(folder, "INSERT INTO redraw VALUES (1, 0, ?, x'00')", candidate)
    with pytest.raises(DamagedJournalError):
        journal.last_generation()


def test_jobs_of_any_generation_are_found_by_an_index(journal, monkeypatch):
    journal.results.index_scores()
    plans, read = [], journal.read

    def explain(query, *values):
        plans.append([each[-1] for each in read(f"EXPLAIN QUERY PLAN {query}", *values)])
        return []

    monkeypatch.setattr(journal, "read", explain)
    for kind in ("evaluate", "score"):
        list(journal.results.with_digests(kind, "fitness", [bytes([each]) for each in range(100)], UNCHECKED))
    assert [plan[0] for plan in plans] == [
        "SEARCH result USING INDEX evaluation_digest (digest=? AND kind=?)",
        "SEARCH result USING INDEX score_digest (digest=? AND kind=?)",
    ]
    assert all("verification_digest" in plan[-1] for plan in plans)


def test_results_of_a_run_of_batches_wait_for_their_check_in_any_generation(journal):
    journal.results.index_scores()
    fill(journal)
    early, late = (Generation(number, SPEC, VECTORS, [7]).work for number in (0, 5))
    assert journal.verification.unverified([each.job for each in late]).keys() == {each.job.digest for each in early}
    journal.verification.add(early[0].job, "w/00000000", "v", "equal")
    assert journal.verification.unverified([each.job for each in late]).keys() == {early[1].job.digest}
    assert journal.fitness_of("score", late) == {each.job.digest: float(value) for value, each in enumerate(early)}


def test_a_check_stands_again_with_its_result_though_another_generation_asked_for_it(journal):
    (first,), work = (Evaluation(number, VECTORS[0], 1).work(SPEC) for number in (3, 5))
    first, again = first.job, work[0].job
    journal.results.add(first, Result(first.digest, 5.0, 10, 0.5, None, None), "w/00000000", "f", 1, "class")
    journal.verification.add(again, "w/00000000", "v", "equal")
    journal.recalls._set_aside(REWOUND, "generation = 3")
    journal.recalls._settle_recall()
    assert journal.fitness_of("evaluate", work) == {again.digest: 5.0}
    assert journal.verification.unverified([again]) == {}


def test_only_the_last_two_states_stay(journal):
    for number in range(5):
        journal.open_generation(number, b"s", 0.1, [number], VECTORS)
    journal.commit()
    count = journal._connection.execute("SELECT count(*) FROM strategy").fetchone()[0]
    assert count == 2


def test_finalists_are_the_best_means_each_once_those_with_failed_episodes_last(journal):
    vectors = [bytes([each]) * 8 for each in range(5)]
    rows = ((1, 0, 5.0, 0), (2, 1, 7.0, 0), (3, 1, 7.0, 0), (4, 2, 7.0, 0), (5, 3, 6.0, 0), (6, 4, 9.0, 1))
    for generation, vector, mean, failed in rows:
        journal.schedule_evaluation(Evaluation(generation, vectors[vector], 2))
        journal.finish_evaluation(generation, StoredEvaluation(generation, 2 - failed, mean, 1.0, failed), failed)
    assert [each.generation for each in journal.finalists(5)] == [2, 4, 5, 1, 6]
    assert journal.finalists(1) == [Finalist(2, vectors[1], 2, 7.0)]


def test_a_run_is_never_overwritten(folder, random_bundle):
    with pytest.raises(JournalError, match=r"--run.*--resume"):
        Journal.create(folder, SETTINGS, random_bundle.path)


@pytest.mark.parametrize(
    ("damage", "error"),
    [
        (lambda folder: ((folder / JOURNAL).unlink(), change_journal(folder, "CREATE TABLE t (x)")), JournalError),
        (lambda folder: (folder / JOURNAL).write_text("this is no database, but as long as one" * 30),
         DamagedJournalError),
        *((partial(change_journal, statement=f"PRAGMA user_version = {number}"), JournalError)
          for number in (-5, 0, 1, 2, 8, 9, 99)),
    ],
)  # fmt: skip
def test_a_foreign_or_damaged_journal_is_refused_and_untouched(folder, damage, error):
    path = folder / JOURNAL
    damage(folder)
    before = path.read_bytes()
    for opening in (Journal, lambda path: RunFolder(path.parent)):
        with pytest.raises(JournalError) as refused:
            opening(path)
        assert refused.type is error
    assert path.read_bytes() == before


def test_a_full_disk_is_a_clear_error(journal):
    journal._connection.execute("PRAGMA max_page_count = 20")
    journal.open_generation(0, bytes(400_000), 0.1, [1], VECTORS)
    with pytest.raises(NotWritableNowError):
        journal.commit()


def test_an_unknown_run_names_those_that_exist(folder):
    with pytest.raises(JournalError, match=r"'day' .*night"):
        open_run(folder.parent, "day")
    for number in range(2000):
        (folder.parent / f"day-{number}").mkdir()
        (folder.parent / f"day-{number}" / "journal.sqlite").touch()
    with pytest.raises(JournalError, match=r"night, .* 1,993 "):
        open_run(folder.parent, "nighte")


def test_a_run_is_live_while_its_folder_is_held_by_one(journal, folder):
    journal.commit()
    with RunFolder(folder) as run:
        assert run.state == "open"
        with run_lock(folder):
            assert run.state == "live"
            with pytest.raises(UsageError, match="night"), run_lock(folder):
                pass
        assert run.state == "open"
    journal.set_fact("ended", "7 generations")
    journal.commit()
    with RunFolder(folder) as run, run_lock(folder):
        assert run.state == "ended: 7 generations"


def test_a_journal_that_is_overwritten_in_place_is_noticed_and_readers_are_not(journal, folder):
    fill(journal)
    journal.begin_incarnation()
    journal.commit()
    journal._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    with RunFolder(folder) as run:
        assert run.history()
    assert not journal.is_overwritten
    journal.commit()
    path = folder / "journal.sqlite"
    with path.open("r+b") as file:
        file.write(bytes(path.stat().st_size))
    journal.commit()
    assert journal.is_overwritten


def test_a_second_life_in_one_journal_is_noticed_by_the_first(journal, folder):
    journal.begin_incarnation()
    journal.commit()
    journal.check_incarnation()
    other = Journal(folder / "journal.sqlite")
    other.begin_incarnation()
    other.commit()
    other.close()
    with pytest.raises(JournalError, match=f"{folder.name}.* 2.* 1"):
        journal.check_incarnation()


def test_a_truncated_log_is_noticed_and_copied_from_memory(journal, folder, tmp_path):
    fill(journal)
    os.truncate(folder / "journal.sqlite-wal", 0)
    journal.set_fact("later", "1")
    with pytest.raises(JournalError, match=folder.name):
        journal.commit()
    journal.save_copy(tmp_path / "journal.sqlite")
    with RunFolder(tmp_path) as copy:
        assert len(copy.history()) == 1
        assert copy.fact("later") is None, "nobody was told that it counts"


def test_huge_texts_are_read_in_part(journal, folder):
    journal.begin_incarnation()
    journal.add_event("x" * 10_000_000)
    fill(journal)
    journal.add_failure(Generation(1, SPEC, VECTORS, [8]).work[0].job, Failure("y" * 10_000_000, "x"), ["w"], 3)
    journal.commit()
    with RunFolder(folder) as run:
        assert [len(each.text) for each in run.events()][1:] == [1000]
        assert [len(each.error) for each in run.failures()] == [1000]


def test_a_read_only_view_of_a_live_run_shows_what_is_in_its_write_ahead_log(folder, journal, tmp_path):
    fill(journal)
    with read_only_view(folder.parent, tmp_path.parent / "view") as view:
        if view is None:
            pytest.skip("this host does not let us mount")
        with RunFolder(view / "night") as seen:
            assert len(seen.history()) == 1
        shutil.copy(folder / "journal.sqlite-wal", tmp_path / "log")
        journal.close()
        shutil.move(tmp_path / "log", folder / "journal.sqlite-wal")
        with pytest.raises(JournalError):
            RunFolder(view / "night").history()


def side_files(folder):
    return [each.name for each in sqlite_side_files(folder / "journal.sqlite") if each.exists()]


def read(folder):
    with RunFolder(folder) as run:
        return run.history()


@pytest.mark.parametrize("readers", [1, 3])
def test_the_last_reader_of_a_run_that_ended_meanwhile_leaves_nothing(folder, journal, readers):
    fill(journal)
    opened = [RunFolder(folder) for _ in range(readers)]
    before = [each.history() for each in opened]
    journal.close()
    assert read(folder) == before[0]
    for each in opened:
        assert each.history() == before[0]
        each.close()
    assert side_files(folder) == []
    assert read(folder) == before[0], "though nobody serves it any more"
    assert side_files(folder) == []


def test_a_reader_takes_nothing_from_a_coordinator(folder, journal):
    fill(journal)
    assert read(folder)
    assert side_files(folder) == ["journal.sqlite-wal", "journal.sqlite-shm"]
    journal.set_fact("name", "later")
    journal.commit()
    journal.close()
    again = Journal(folder / "journal.sqlite")
    assert read(folder)
    assert again.fact("name") == "later"
    again.set_fact("name", "last")
    again.commit()
    again.close()
    with RunFolder(folder) as run:
        assert run.fact("name") == "last"
    assert side_files(folder) == []


def test_the_command_that_removes_a_run_in_the_way_names_its_folder_of_runs(folder):
    with pytest.raises(JournalError) as refused:
        Journal.check_absent(folder)
    words = shlex.split(str(refused.value).split("`")[1])
    assert words[-5:] == ["runs", "delete", folder.name, "--runs-dir", str(folder.parent)]


def test_the_command_that_puts_a_rescued_journal_back_touches_no_other_file(tmp_path, random_bundle, monkeypatch):
    monkeypatch.setattr(file_watch, "SETTLE", 0)
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "my runs" / "night"
    others = [tmp_path / "my", tmp_path / "runs" / "night" / "journal.sqlite-wal"]
    folder.mkdir(parents=True)
    others[1].parent.mkdir(parents=True)
    Journal.create(folder, SETTINGS, random_bundle.path).close()
    journal = Journal(folder / "journal.sqlite")
    watch = file_watch.FileWatch(journal, None, lambda _: "true")
    watch.check(0.0)
    journal.path.rename(folder / "away")
    log = folder / "journal.sqlite-wal"
    log.unlink(missing_ok=True)
    for path in (journal.path, log, *others):
        path.write_text("another program's")
    with pytest.raises(JournalError) as left:
        watch.check(1e9)
    watch.close()
    journal.close()
    subprocess.run(["sh", "-ec", re.search(r" (rm .*)", str(left.value))[1]], check=True)
    assert not log.exists()
    assert [each.read_text() for each in others] == ["another program's"] * 2
    with RunFolder(folder) as run:
        assert run.settings == SETTINGS


SEEDS = (1, 2)


@pytest.fixture
def checked(tmp_path, random_bundle):
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


def unverified(checked, number):
    return set(checked.verification.unverified([work.job for work in jobs_of(number)]))


def digests_of(number):
    return {work.digest for work in jobs_of(number)}


def test_a_check_does_not_stand_again_by_the_word_of_a_host_that_was_barred(checked):
    checked.recalls.rewind(0, b"state", SEEDS)
    checked.recalls.recall({"b"})
    checked.open_generation(1, b"state", 0.1, SEEDS, VECTORS)
    checked.recalls.count_again(jobs_of(1))
    assert set(checked.results.of("score", 1)) == digests_of(1), "what a brought counts again"
    assert unverified(checked, 0) == digests_of(0)
    assert unverified(checked, 1) == digests_of(1)
    checked.verification.unbar("b")
    checked.recalls.rewind(0, b"state", SEEDS)
    checked.recalls.count_again(jobs_of(1))
    assert unverified(checked, 1) == digests_of(1), "nor once it may come again"


def test_a_check_stands_again_by_the_word_of_a_host_that_was_not_barred(checked):
    checked.recalls.rewind(0, b"state", SEEDS)
    checked.open_generation(1, b"state", 0.1, SEEDS, VECTORS)
    checked.recalls.count_again(jobs_of(1))
    assert not unverified(checked, 0)
    assert not unverified(checked, 1)


def test_what_a_dropped_evaluation_had_counts_for_an_earlier_one_of_the_same_mean(checked):
    last, first = (Evaluation(number, VECTORS[0], 3) for number in (1, 0))
    seeds = {}
    for job in (each.job for each in last.work(SPEC)):
        seeds[job.seeds[0]] = float(job.episode)
        checked.results.add(job, Result(job.digest, float(job.episode), 10, 0.1, None, None), "a/1", "f", 1, "class")
        checked.verification.add(job, "a/1", "b", "equal")
    checked.schedule_evaluation(last)
    checked.recalls.rewind(0, b"state", SEEDS)
    checked.schedule_evaluation(first)
    assert len(checked.fitness_of("evaluate", first.work(SPEC))) == 3
    checked.finish_evaluation(0, StoredEvaluation(0, 3, 1.0, 0.8), 0)
    checked.commit()
    with RunFolder(checked.path.parent) as run:
        run.verify()
        assert run.scores(0) == seeds
    checked.recalls.recall({"b"})
    assert checked.pending_evaluations() == [first], "its checks are of its generation, too"


def test_a_recall_begins_where_a_host_alone_confirmed_what_others_brought(checked):
    assert checked.recalls.first_brought({"a"}) == checked.recalls.first_brought({"b"}) == {"score": 0}
    checked.recalls.recall({"b"})
    assert checked.recalls.first_brought({"b"}) == {}, "its word is gone"
    for work in jobs_of(1):
        checked.verification.add(work.job, "a/1", "c", "equal")
    assert checked.recalls.first_brought({"c"}) == {"score": 1}
    assert checked.recalls.first_brought({"d"}) == {}


def test_an_evaluation_of_which_a_barred_host_alone_confirmed_a_part_is_finished_again(checked):
    for number, checker in enumerate("bc"):
        evaluation = Evaluation(number, VECTORS[number], 1)
        checked.schedule_evaluation(evaluation)
        (work,) = evaluation.work(SPEC)
        checked.results.add(work.job, Result(work.digest, 1.0, 10, 0.1, None, None), "a/1", "f", 1, "class")
        checked.verification.add(work.job, "a/1", checker, "equal")
        checked.finish_evaluation(number, StoredEvaluation(number, 1, 1.0, 0.0), 0)
    checked.recalls.recall({"b"})
    assert [each.generation for each in checked.pending_evaluations()] == [0]


def test_who_only_confirmed_the_report_decided_about_no_candidate_and_no_evaluation(checked):
    checked.schedule_evaluation(Evaluation(0, VECTORS[0], 1))
    seeds = validation_seeds(2, CHOOSING_OFFSET)
    scored, failed = (each.job for each in make_jobs(SPEC, "evaluate", 0, 0, VECTORS[0], seeds, first=CHOOSING_OFFSET))
    checked.results.add(scored, Result(scored.digest, 1.0, 10, 0.1, None, None), "c/1", "f", 1, "class")
    checked.verification.add(scored, "c/1", "d", "equal")
    checked.add_failure(failed, Failure("no score", ""), ["e/1"], 1)
    checked.finish_evaluation(0, StoredEvaluation(0, 1, 1.0, 0.0), 0)
    for host in "dec":
        assert checked.recalls.first_brought({host}) == {"confirm": 0}
        checked.recalls.recall({host})
        assert not checked.pending_evaluations()
    assert not checked.read("SELECT 1 FROM failure UNION SELECT 1 FROM result WHERE kind = 'evaluate'")


@pytest.mark.parametrize(("barred", "stands"), [("b", True), ("c", True), ("bc", True), ("b c", False)])
def test_a_check_of_several_hosts_stands_while_one_of_them_is_believed(checked, barred, stands):
    (work, *_) = jobs_of(0)
    checked.write("UPDATE verification SET checker = 'b,c', outcome = 'differs' WHERE digest = ?", work.digest)
    for host in barred.split():
        checked.recalls.recall({host})
    assert (work.digest not in unverified(checked, 0)) == stands


def test_what_a_closed_race_did_not_want_is_aside_and_counts_again_if_its_generation_opens_again(checked):
    steps, work = checked.results.effort.steps, jobs_of(1)
    surplus, *others = [each.digest for each in work]
    checked.recalls.set_surplus_aside(1, [surplus])
    assert set(checked.results.of("score", 1)) == set(others)
    assert checked.results.effort.steps == steps - 10
    checked.recalls.count_again(work[:1])
    assert surplus not in checked.results.of("score", 1), "its generation is closed"
    checked.recalls.rewind(1, b"state", SEEDS)
    assert set(checked.results.of("score", 1)) == {surplus, *others}
    assert checked.results.effort.steps == steps
    assert not unverified(checked, 1)


def test_what_a_race_of_a_dropped_generation_did_not_want_counts_again_when_its_job_is_wanted(checked):
    surplus, *others = [work.digest for work in jobs_of(1)]
    checked.recalls.set_surplus_aside(1, [surplus])
    checked.recalls.rewind(0, b"state", SEEDS)
    checked.recalls.count_again(jobs_of(1))
    assert set(checked.results.of("score", 1)) == {surplus, *others}


def test_what_a_race_did_not_want_of_a_barred_host_never_counts_again(checked):
    surplus, *_ = [work.digest for work in jobs_of(1)]
    checked.recalls.set_surplus_aside(1, [surplus])
    checked.recalls.recall({"a"})
    checked.recalls.rewind(1, b"state", SEEDS)
    assert not checked.results.of("score", 1)
    assert checked.verification.counts()["recalled"] == 8
