"""What a run reports as it ends: chosen on further tracks, scored on tracks that chose nothing; its evaluations.
Tests evaluation.py."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.protocol.stop_kind import StopKind
from dreamfleet.common.runs.paired_difference import is_clearly_below
from dreamfleet.common.runs.records import StoredEvaluation
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.common.runs.seeds import CHOOSING_OFFSET, CONFIRMING_OFFSET, VALIDATION
from dreamfleet.coordinator.jobs.confirmation import FINALISTS, Confirmation, Finalist, total_episodes
from dreamfleet.coordinator.jobs.evaluation import Evaluation, Evaluations
from dreamfleet.coordinator.settings.limits import LimitsConfig
from tests.support.run_bench import SETTINGS, Bench
from tests.support.samples import SPEC

JUDGED = replace(SETTINGS, collect_every=0, evaluate_every=1, evaluation_episodes=4, population=4, confirm_episodes=8)
GENERATIONS = 6


def number_of(data):
    """A number between 0 and 1, pseudorandom."""
    return int.from_bytes(hashlib.sha256(data).digest()[:6], "little") / 2**48


def drive(job):
    """A course whose outcome is nothing but luck."""
    return 1000 * number_of(job.vector + bytes(str(job.seeds), "ascii"))


class Judging(Bench):
    """Every job is driven as soon as it is given; each one that judges is kept, with the incarnation that gave it."""

    judged: list

    def fitness_of(self, job):
        if job.kind != "evaluate":
            return float(job.digest[0])
        self.judged.append(job)
        return drive(job)

    @property
    def tracks(self):
        """The validation tracks that each generation's mean was driven on."""
        found = {}
        for job in self.judged:  # one may be given twice, to a worker that shows so how soon it is
            found.setdefault(job.generation, set()).add(job.seeds[0] - VALIDATION.start)
        return found

    def outcome(self):
        with RunFolder(self.path) as stored:
            return stored.confirmation(), Controller.load(self.path / CONTROLLER), stored.evaluations()


@pytest.fixture
def make(make_bench):
    def begin(settings=JUDGED, generations=GENERATIONS):
        Judging.judged = []
        return make_bench(Judging, settings, generations)

    return begin


def test_what_is_reported_was_driven_on_tracks_that_chose_nothing_and_the_best_few_on_those_that_chose(make):
    bench = make()
    bench.end()
    confirmed, controller, evaluations = bench.outcome()
    chosen = [track for tracks in bench.tracks.values() for track in tracks if track < CONFIRMING_OFFSET]
    fresh = [job for job in bench.judged if job.seeds[0] - VALIDATION.start >= CONFIRMING_OFFSET]
    fresh.sort(key=lambda job: job.seeds)
    assert {job.generation for job in fresh} == {confirmed.generation}
    assert [job.seeds[0] - VALIDATION.start for job in fresh] == list(range(CONFIRMING_OFFSET, CONFIRMING_OFFSET + 8))
    assert not set(chosen) & {job.seeds[0] - VALIDATION.start for job in fresh}
    scores = [drive(job) for job in fresh]
    assert (confirmed.mean, confirmed.error) == (np.mean(scores), np.std(scores, ddof=1) / np.sqrt(8))
    provenance = controller.provenance
    assert (provenance["confirmed"], provenance["generation"]) == (True, confirmed.generation)
    assert (provenance["validation_mean"], provenance["validation_error"]) == (confirmed.mean, confirmed.error)
    assert provenance["validation_episodes"] == 8
    assert len(evaluations) == GENERATIONS, "the evaluations stay what they were"
    ranked = sorted(evaluations, key=lambda each: -each.mean)
    rounds = {each.generation: [t for t in bench.tracks[each.generation] if t >= CHOOSING_OFFSET] for each in ranked}
    lengths = sorted((len([t for t in tracks if t < CONFIRMING_OFFSET]) for tracks in rounds.values()), reverse=True)
    assert lengths == [6, 6, 2, 2, 0, 0], "four drive 2 tracks, two drive 4 more"
    assert {generation for generation, tracks in rounds.items() if tracks} == {e.generation for e in ranked[:FINALISTS]}
    assert sorted(rounds[confirmed.generation])[:6] == list(range(CHOOSING_OFFSET, CHOOSING_OFFSET + 6))


def test_the_episodes_that_the_end_takes_are_predicted(make):
    night = make()
    while not night.run.state.reached:
        night.step()
    predicted, before = night.run.background_jobs.episodes_until_end(ending=True), {job.digest for job in night.judged}
    night.end()
    assert len({job.digest for job in night.judged} - before) == predicted > 3 * JUDGED.confirm_episodes - 1
    assert night.run.background_jobs.episodes_until_end(ending=True) == 0
    assert [total_episodes(finalists, 16) for finalists in range(5)] == [0, 16, 32, 47, 48]
    assert [total_episodes(finalists, 0) for finalists in range(5)] == [0, 0, 0, 0, 0], "nothing is confirmed"


@settings(max_examples=60)
@given(count=st.integers(1, FINALISTS), episodes=st.integers(2, 40), seed=st.integers(0, 99), known=st.floats(0.0, 1.0))
def test_in_any_order_and_whatever_is_known_already_the_outcome_is_the_same(count, episodes, seed, known):
    finalists = [Finalist(each, bytes([each]) * 16, 4, 500.0 + each) for each in range(count)]

    def outcome(known, rng=None):
        confirmation, given = Confirmation(SPEC, episodes, finalists, 9), 0

        def lucky(work):
            scores = {each.digest: 1000 * number_of(each.digest) for each in work}
            return {digest: score for digest, score in scores.items() if number_of(digest + b"known") < known}

        while work := confirmation.advance(lucky):
            for place in range(len(work)) if rng is None else rng.permutation(len(work)):
                assert confirmation.in_progress
                confirmation.record(work[place].job.digest, 1000 * number_of(work[place].job.digest))
            given += len(work)
            assert not confirmation.in_progress
        assert given <= 3 * max(episodes, FINALISTS)
        return confirmation.outcome

    assert outcome(0.0) == outcome(known, np.random.default_rng(seed)) == outcome(1.0)


def test_a_run_that_ended_goes_on_and_is_confirmed_again(make):
    bench = make(generations=3)
    bench.end()
    first, *_ = bench.outcome()
    bench.restart()
    assert bench.run.state.ended.kind is StopKind.GENERATIONS, "nothing is driven again"
    assert bench.outcome()[0] == first
    bench.limits = LimitsConfig(generations=9)
    bench.restart()
    assert bench.run.background_jobs.confirmed == first
    before, Judging.judged = {job.digest for job in bench.judged}, []
    while len(bench.run.history) < 9:
        bench.step()
        best = bench.run.background_jobs.evaluations.best
        assert (bench.run.background_jobs.confirmed is None) == (best.generation >= 3)
        provenance = bench.run.background_jobs.report.current.controller().provenance
        reported = (False, best.generation) if best.generation >= 3 else (True, first.generation)
        assert (provenance["confirmed"], provenance["generation"]) == reported
    bench.end()
    second, *_ = bench.outcome()
    assert second.closed == 9
    assert not before & {job.digest for job in bench.judged}, "no track was driven twice"


@pytest.mark.parametrize("changes", [{"confirm_episodes": 0}, {"evaluate_every": 0}])
def test_where_nothing_is_to_be_confirmed_a_run_ends_as_it_did(make, changes):
    bench = make(replace(JUDGED, **changes))
    bench.end()
    confirmed, controller, evaluations = bench.outcome()
    assert confirmed is None
    assert not controller.provenance["confirmed"]
    assert max((track for tracks in bench.tracks.values() for track in tracks), default=0) < CHOOSING_OFFSET
    assert len(evaluations) == (GENERATIONS if changes.get("evaluate_every", 1) else 0)


def test_one_evaluation_needs_no_choice(make):
    bench = make(generations=1)
    bench.end()
    assert sorted(bench.tracks[0])[-8:] == list(range(CONFIRMING_OFFSET, CONFIRMING_OFFSET + 8))
    assert max(sorted(bench.tracks[0])[:-8]) < CHOOSING_OFFSET


TRACKS = np.random.default_rng(1).normal(0, 200, 16)  # what each track adds to every mean's score


def evaluated(*means, missing=()):
    """Evaluations that differ by track as controllers do: by `TRACKS`, and by a little noise; and their scores."""
    noise = np.random.default_rng(2).normal(0, 10, (len(means), 16))
    scores = {
        generation: {
            seed: float(mean + TRACKS[seed] + noise[generation, seed])
            for seed in range(16)
            if (generation, seed) not in missing
        }
        for generation, mean in enumerate(means)
    }
    rows = [StoredEvaluation(generation, 16, mean, 200.0) for generation, mean in enumerate(means)]
    return Evaluations(rows), scores.__getitem__


@pytest.mark.parametrize(
    ("means", "count", "expected"),
    [
        ((), 1, False),
        ((500.0,), 1, False),
        ((500.0, 499.0), 1, False),
        ((500.0, 475.0), 1, True),
        ((500.0, 475.0), 2, False),
        ((500.0, 475.0, 499.0), 2, False),
        ((500.0, 475.0, 480.0), 2, True),
        ((300.0, 500.0, 475.0, 480.0), 2, True),
        ((100.0, 300.0, 500.0), 2, False),
    ],
)
def test_dream_and_reality_have_parted_when_the_last_means_lie_clearly_below_the_best(means, count, expected):
    """Here by half the error of a mean: the tracks' differences cancel, for all evaluations have the same tracks."""
    found, find_scores = evaluated(*means)
    assert found.have_fallen_behind(count, find_scores) == expected


def test_evaluations_are_compared_on_the_tracks_that_both_have_scores_of():
    """Without the hardest tracks of the one and the easiest of the other, means alone would say the opposite."""
    hard, easy = np.argsort(TRACKS)[:6], np.argsort(TRACKS)[-6:]
    found, find_scores = evaluated(500.0, 400.0, missing={(0, each) for each in easy} | {(1, each) for each in hard})
    assert np.mean(list(find_scores(1).values())) > np.mean(list(find_scores(0).values()))
    assert found.have_fallen_behind(1, find_scores)


def test_fewer_than_two_common_tracks_show_nothing_and_two_take_students_t():
    """With two tracks, four standard errors are no finding: t is 14 at the probability of two of many."""
    assert not is_clearly_below({}, {})
    assert not is_clearly_below({1: -900.0}, {1: 900.0, 2: 900.0})
    assert not is_clearly_below({1: 100.0, 2: 160.0}, {1: 250.0, 2: 250.0})
    assert is_clearly_below({1: 100.0, 2: 104.0}, {1: 250.0, 2: 250.0})
    assert not is_clearly_below({1: 250.0, 2: 250.0}, {1: 100.0, 2: 104.0}), "above"


def test_evaluations_of_one_mean_share_their_scores_whichever_is_asked_first():
    """A run that has converged evaluates the same vector again."""
    evaluations, vector = Evaluations(), np.zeros(4, np.float32).tobytes()
    first = evaluations.open(Evaluation(2, vector, 3), SPEC, {})
    assert len(first) == 3
    assert evaluations.open(Evaluation(5, vector, 3), SPEC, {}) == []
    for number, work in enumerate(first):
        assert evaluations.record(work.job.digest, float(number)) == [2, 5]
    finished = [evaluations.finish(generation).found for generation in (2, 5)]
    assert [each.mean for each in finished] == [1.0, 1.0]
    assert Evaluations([*evaluations.rows, StoredEvaluation(6, 2, 9.0, 0.0, failed=1)]).best.generation == 2
    known = {work.job.digest: 4.0 for work in first}
    assert evaluations.open(Evaluation(8, vector, 3), SPEC, known) == []
    assert evaluations.finish(8).found.mean == 4.0
