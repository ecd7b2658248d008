"""A run that is taken back to an earlier generation, in a real journal and with real optimisers.

Tests common/runs/journal/candidate_counts.py, coordinator/storage/recall_records.py and verification.py.
"""

import sqlite3
from contextlib import closing
from dataclasses import replace
from functools import partial
from unittest.mock import Mock

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import DamagedJournalError, JournalError, NotWritableNowError, UsageError
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.run_paths import CONTROLLER, JOURNAL
from dreamfleet.common.runs.stages import StageTracker, stages_of
from dreamfleet.coordinator.jobs.history import History
from dreamfleet.coordinator.optimisers.evolution import Evolution
from dreamfleet.coordinator.run.failure_policy import LIMIT_FROM
from dreamfleet.coordinator.run.generations import Generations
from dreamfleet.coordinator.run.recall import bar_stored, recall
from dreamfleet.coordinator.service.control import DRAINING
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.storage.journal import Journal
from tests.support import run_bench
from tests.support.dispatched import result
from tests.support.failing_runs import GENERATIONS, SETTINGS, Failing
from tests.support.run_bench import A, B, Bench, result_of

DONE = ("barred", "recalled")  # what the events of a recall are
OPTIMISERS = ["cma", "full", "cmaes-lra", "openes", "pepg", "snes", "xnes"]


CMA = replace(SETTINGS, evaluate_every=1, evaluation_episodes=2)


@pytest.fixture
def ended(failing):
    """Begins a run and serves it to its end."""

    def build(settings=CMA, **options):
        bench = failing(settings=settings, **options)
        assert bench.run.state.ended
        return bench

    return build


def live_on(bench):
    """A further incarnation of the coordinator, to its end."""
    bench.journal.commit()
    bench.restart()
    bench.serve()
    assert bench.run.state.ended


def outcome(bench):
    with RunFolder(bench.path) as run:
        vectors = [run.candidate(each, 0).tolist() for each in range(GENERATIONS + 1)]
        return [replace(each, seconds=0.0) for each in run.history()], run.evaluations(), vectors


class Lying(Failing):
    """Host a praises the first candidates of each generation, in the first half of their episodes."""

    def answer_one(self, name, job):
        lie = 100.0 if name == A and job.kind == "score" and job.candidate < 3 and job.episode < 2 else 0.0
        self.deliver(name, result(job.digest, self.fitness_of(job) + lie))


RACE = replace(SETTINGS, episodes=4, racing=True)


def sums(bench):
    """Of each generation and of its candidates: steps, and those of the results."""
    with RunFolder(bench.path) as run:
        candidates = run.candidates()
        return [
            (each.steps, sum(row.steps for row in candidates if row.generation == each.number),
             10 * sum(row.episodes for row in candidates if row.generation == each.number))
            for each in run.history()
        ]  # fmt: skip


def bar(bench, host, others):
    """Bar a host from a run that is served, and go on with others."""
    assert not bench.run.bar(host)
    bench.run.commit()
    bench.hosts = others
    bench.restart()
    bench.admit(*others)
    bench.serve()
    assert bench.run.state.ended


@pytest.mark.exact
@pytest.mark.parametrize("seed", [1, 2])
def test_a_race_from_which_lies_are_recalled_is_one_without_them(ended, begin, seed):
    settings = replace(RACE, seed=seed)
    honest = ended(settings)
    bench = begin(None, settings, Lying)
    bench.serve()
    for host, others in (("a", [B]), ("b", ["c/1"])):  # what a race did not want may be wanted again
        bar(bench, host, others)
        assert bench.story() == honest.story()
        assert sums(bench) == sums(honest)
        assert all(made == counted == scored for made, counted, scored in sums(bench))


class Broken(Failing):
    """What `fails(job)` does so until it is mended; until then the last episodes, and all checks, take for ever."""

    is_broken = True

    def answer_one(self, name, job):
        is_check = self.run.fleet.jobs.is_accepted(job.digest)
        if not (self.is_broken and job.kind == "score" and (job.episode == 3 or is_check)):
            super().answer_one(name, job)


@pytest.mark.exact
def test_a_race_that_is_resumed_after_the_fault_of_a_host_is_one_without_it(ended, begin):
    honest = ended(RACE)
    bench = begin(lambda job: bench.is_broken and job.candidate < 2 and job.episode == 0, RACE, Broken)
    bench.serve(stop=lambda run: any(work.episode == 2 for work in run.generation.counted))
    assert bench.run.generation.failed == [0, 1]
    bench.is_broken = False
    bench.run.resume()
    bench.serve()
    assert bench.run.state.ended
    assert bench.story() == honest.story()
    assert sums(bench) == sums(honest)


def test_what_a_candidate_has_that_failed_for_a_while_is_checked_once_it_is_scored(begin, monkeypatch):
    monkeypatch.setattr(run_bench, "NetworkConfig", partial(NetworkConfig, verify=1.0))
    settings = replace(SETTINGS, episodes=4)
    bench = begin(lambda job: bench.is_broken and job.candidate == 0 and job.episode == 1, settings, Broken)
    bench.serve(stop=lambda run: run.generation.failed)
    bench.is_broken = False
    bench.run.resume()
    bench.serve(stop=lambda run: len(run.history) > 0)
    scored = "SELECT digest FROM result WHERE kind = 'score' AND generation = 0"
    checked = "SELECT digest FROM verification WHERE stands AND outcome = 'equal'"
    assert len(bench.journal.read(scored)) == 24
    assert not bench.journal.read(f"{scored} EXCEPT {checked}")
    bench.journal.close()


class Departing(Lying):
    """Each result arrives while the coordinator drains, which is taken back again."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, hosts=(A, B, "c/1"), **kwargs)
        self.admit("c/1")
        self.found = 0

    def answer_one(self, name, job):
        self.run.pause(DRAINING)
        super().answer_one(name, job)
        self.found += self.run.verification.has_findings
        assert not self.run.state.is_rewound
        self.run.resume()


def test_a_coordinator_that_leaves_leaves_also_if_a_host_is_found_wrong(begin, monkeypatch):
    monkeypatch.setattr(run_bench, "NetworkConfig", partial(NetworkConfig, verify=1.0))
    bench = begin(kind=Departing)
    bench.serve(stop=lambda run: run.state.is_rewound)
    assert bench.found
    bench.journal.close()


def new_generations(bench):
    closed, evaluations = bench.journal.read_closed()
    finished = {each.generation: each for each in evaluations}
    return Generations(bench.journal, bench.settings, StageTracker(bench.settings), History(closed), finished)


@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_a_replayed_strategy_asks_for_what_the_stored_one_asks_for(ended, optimiser):
    bench = ended(replace(CMA, **({"covariance": "full"} if optimiser == "full" else {"optimiser": optimiser})))
    settings, asked = bench.settings, []
    for number in (GENERATIONS - 1, GENERATIONS):
        for state in (bench.journal.generation(number).state, new_generations(bench).replay(number).packed()):
            evolution = Evolution.of(settings, stages_of(settings)[0], None, None)
            evolution.restore(state)
            asked.append(evolution.ask())
    np.testing.assert_array_equal(asked[::2], asked[1::2])


@pytest.mark.exact
def test_candidates_that_were_drawn_anew_are_drawn_anew_again(ended):
    fails = lambda job: job.kind == "score" and job.digest[0] % 8 == 0  # noqa: E731
    bench = ended(replace(CMA, on_failure="redraw"), fails=fails)
    before = outcome(bench)
    recall(bench.journal, bench.settings, {"b"})
    live_on(bench)
    assert outcome(bench) == before


def test_what_other_hosts_scored_in_dropped_generations_is_not_scored_again(ended):
    bench = ended()
    mine = {digest for (digest,) in bench.journal.read("SELECT digest FROM result WHERE worker LIKE 'b/%'")}
    recall(bench.journal, bench.settings, {"a"})
    aside = {digest for (digest,) in bench.journal.read("SELECT digest FROM recalled WHERE because = 'rewound'")}
    assert aside
    assert aside <= mine
    live_on(bench)
    again = "SELECT digest FROM result WHERE worker LIKE 'b/%' AND incarnation = 1"
    assert {digest for (digest,) in bench.journal.read(again)} == mine


def test_what_a_host_brought_to_dropped_generations_counts_no_more_once_it_is_barred(ended):
    bench = ended()
    before = outcome(bench)
    for host in ("a", "b"):
        recall(bench.journal, bench.settings, {host})
    assert bench.journal.last_generation().number == 0
    assert set(bench.journal.read("SELECT because FROM recalled")) == {("barred",)}
    live_on(bench)
    assert not bench.journal.read("SELECT 1 FROM result WHERE incarnation = 1")
    assert outcome(bench) == before


def test_a_journal_of_another_host_is_not_rewound(ended):
    bench = ended()
    bench.journal.write("UPDATE candidate SET vector = ? WHERE generation = 0 AND number = 0", bytes(24))
    with pytest.raises(JournalError):
        new_generations(bench).replay(2)


def collect(bench):
    """Keep all rollouts of a run; their files."""
    for name, job in bench.reach_collection():
        for part in bench.parts(job):
            bench.upload(name, part)
        bench.deliver(name, result_of(job))
    assert bench.run.state.ended
    with RunFolder(bench.path) as run:
        return run.rollouts()


def test_files_of_recalled_rollouts_are_removed_and_those_that_are_collected_again_stay(make_bench):
    bench = make_bench(Bench)
    files = collect(bench)
    whole = [path.read_bytes() for path in files]
    recall(bench.journal, bench.settings, {"a"})
    bench.journal.commit()
    assert all(path.exists() for path in files)
    bench.restart()
    assert not any(path.exists() for path in files)
    assert collect(bench) == files
    assert [path.read_bytes() for path in files] == whole
    bench.restart()
    assert all(path.exists() for path in files)
    bench.journal.close()
    bar_stored(bench.path, "a", is_barred=True)
    assert not any(path.exists() for path in files), "though nobody serves the run"


def test_a_host_is_barred_from_a_run_that_has_ended_and_comes_again(ended):
    bench = ended()
    before = outcome(bench)
    bench.journal.close()
    with pytest.raises(UsageError, match=r"\bc\b.* a, b"):
        bar_stored(bench.path, "c", is_barred=True)
    with pytest.raises(UsageError, match=r"\ba\b"):
        bar_stored(bench.path, "a", is_barred=False)
    bar_stored(bench.path, "a", is_barred=True)
    with RunFolder(bench.path) as run:
        assert run.ended is None
        assert (run.checks.barred, run.checks.by_operator) == (("a",), ("a",))
        assert run.checks.recalled > 0
    bench.journal = Journal(bench.path / "journal.sqlite")
    bench.hosts = [B]
    bench.begin()
    bench.serve()
    assert outcome(bench) == before
    assert {worker for (worker,) in bench.journal.read("SELECT DISTINCT worker FROM result")} == {B}
    bench.journal.close()
    bar_stored(bench.path, "a", is_barred=False)
    with RunFolder(bench.path) as run:
        assert (run.checks.barred, run.checks.by_operator) == ((), ())


def test_a_reported_controller_is_withdrawn_before_its_recall_is_durable_and_a_life_writes_it_again(ended, monkeypatch):
    bench = ended()
    path = bench.path / CONTROLLER
    before = Controller.load(path)
    with monkeypatch.context() as patched:
        patched.setattr(Journal, "commit", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            bench.run.bar("a")
    assert not path.exists()
    bench.restart()  # it was killed before the commit
    assert bench.run.state.ended
    assert Controller.load(path).sha256 == before.sha256
    assert not bench.run.bar("a")
    bench.run.commit()
    assert not path.exists()
    path.write_bytes(b"of what was recalled")
    bench.restart()
    assert not bench.run.history
    bench.run.commit()
    assert not path.exists()
    bench.hosts = [B]
    bench.serve()
    assert Controller.load(path).sha256 == before.sha256


def test_a_bar_that_is_killed_leaves_a_run_without_a_controller_or_all_of_the_recall(ended, monkeypatch):
    bench = ended()
    bench.journal.close()
    with monkeypatch.context() as patched:
        patched.setattr(Journal, "commit", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            bar_stored(bench.path, "a", is_barred=True)
    assert not (bench.path / CONTROLLER).exists()
    with RunFolder(bench.path) as run:
        assert run.ended
        assert run.checks is None
    bar_stored(bench.path, "a", is_barred=True)
    assert not (bench.path / CONTROLLER).exists()


def test_a_run_that_is_served_is_not_rewound_by_what_somebody_wrote_into_its_journal(ended):
    bench = ended()
    with closing(sqlite3.connect(bench.path / JOURNAL)) as other, other:
        other.execute("UPDATE result SET fitness = 123 WHERE kind = 'score' AND generation = 0 AND candidate = 0")
    with pytest.raises(DamagedJournalError):
        bench.run.bar("a")
    assert not bench.journal.read("SELECT 1 FROM recalled")
    bench.journal.close()


@pytest.mark.parametrize("refusal", ["damage", "no optimiser"])
def test_a_bar_that_is_refused_changes_nothing(ended, monkeypatch, refusal):
    bench = ended()
    bench.run.leave()
    if refusal == "damage":
        bench.journal.write("UPDATE result SET fitness = 123 WHERE kind = 'score' AND generation = 0 AND candidate = 0")
        bench.journal.commit()
    else:
        monkeypatch.setattr(Evolution, "of", Mock(side_effect=UsageError("cannot be imported")))
    with closing(bench.journal):
        before = [*bench.journal._connection.iterdump()]
    with pytest.raises((DamagedJournalError, UsageError)):
        bar_stored(bench.path, "b", is_barred=True)
    with closing(Journal(bench.path / JOURNAL)) as journal:
        assert [*journal._connection.iterdump()] == before
    assert (bench.path / CONTROLLER).exists()


def test_a_bar_on_a_full_disk_is_refused_and_changes_nothing(begin, monkeypatch):
    bench = begin(settings=CMA)
    bench.serve(stop=lambda run: len(run.history) == 2)
    bench.run.commit()
    with RunFolder(bench.path) as run:
        before = run.history()
    with monkeypatch.context() as patched:
        patched.setattr(Journal, "commit", Mock(side_effect=NotWritableNowError("the disk is full")))
        assert bench.run.bar("a")
        assert bench.run.state.stalled is not None
        assert not bench.run.commit()
        assert bench.run.bar("a"), "it is not asked again while the disk is full"
    bench.wait(10.0)
    assert bench.run.commit()
    assert [each.what for each in bench.run.take_notes() if each.what in DONE or each.what == "paused"] == ["paused"]
    with RunFolder(bench.path) as run:
        assert run.checks is None
        assert run.history() == before
    bench.restart()
    assert not bench.run.admission.barred
    assert bench.run.bar("a") == ""
    bench.restart()
    assert [*bench.run.admission.barred] == ["a"]


@pytest.mark.parametrize(("since", "kept"), [(1, "1"), (3, None)])
def test_failures_that_were_accepted_after_the_generation_that_opens_again_count_again(ended, since, kept):
    bench = ended()
    bench.journal.set_fact(LIMIT_FROM, str(since))
    recall(bench.journal, bench.settings, {"a"})
    assert bench.journal.fact(LIMIT_FROM) == kept
    bench.journal.close()
