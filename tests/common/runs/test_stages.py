"""Stages of a run, and its receipt. Tests run_provenance.py."""

import base64
import hashlib
import itertools
import re
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.artifacts.objective import Objective
from dreamfleet.common.errors import ControllerError
from dreamfleet.common.runs.effort import Effort, format_steps
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.common.runs.records import RunSettings, StageSettings, StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.run_provenance import (
    RECEIPT,
    StartProvenance,
    read_run_provenance,
    read_run_settings,
    validation_seed_ranges,
)
from dreamfleet.common.runs.stages import StageTracker, begun_stages, stage_at, stages_of
from tests.support.samples import SPEC

EVERY = 2
PLAIN = RunSettings(SPEC, ControllerShape(1, 3), 6, 2, 0.1, "diagonal", 1, evaluate_every=EVERY, evaluation_episodes=4)


def scheduled(*stages):
    return replace(PLAIN, stages=stages)


def history(count):
    return [StoredGeneration(number, 1.0, 0.1, 1.2, 0.8, 0.1, 10, 1.0) for number in range(count)]


def evaluated(means):
    return [StoredEvaluation(generation, 4, mean, 1.0) for generation, mean in means.items()]


def numbers(settings, closed, evaluations=()):
    """The stage of each generation."""
    return [stage_at(number, settings, closed, evaluations).stage.number for number in range(len(closed) + 1)]


def test_unchanged_settings_are_those_of_the_stage_before():
    stages = stages_of(scheduled(
        StageSettings(3), StageSettings(2, horizon=400, racing=True), StageSettings(population=9, patience=0),
    ))  # fmt: skip
    named = ("horizon", "patience", "racing", "population", "sigma0")
    assert [tuple(each.values[name] for name in named) for each in stages] == [
        (1000, 100, False, 6, 0.1), (400, 100, True, 6, 0.1), (400, 0, True, 9, 0.1),
    ]  # fmt: skip


def test_another_population_or_step_size_starts_a_new_search():
    later = [StageSettings(population=9), StageSettings(sigma0=0.1), StageSettings(population=6),
             StageSettings(horizon=5, patience=3, episodes=4, racing=True)]  # fmt: skip
    second = [stages_of(scheduled(StageSettings(1), each))[1] for each in later]
    assert [each.starts_new_search for each in second] == [True, True, False, False]
    stages = stages_of(scheduled(StageSettings(1), StageSettings(1, sigma0=0.2), StageSettings(horizon=5)))
    assert [each.search for each in stages] == [1, 2, 2], "a continued search is of the stage that started it"
    restarted = stages_of(scheduled(*RESTARTED))
    assert [each.search for each in restarted] == [1, 2, 3, 3]
    assert " 0.1" in restarted[2].description


@pytest.mark.parametrize(
    ("stages", "means", "found"),
    [
        ((StageSettings(3), StageSettings(1), StageSettings(2), StageSettings()), {}, [1, 1, 1, 2, 3, 3, 4, 4, 4]),
        ((StageSettings(steps=25), StageSettings(steps=1, horizon=50), StageSettings()), {}, [1, 1, 1, 2] + [3] * 5),
        # Once the evaluation is one interval old.
        ((StageSettings(score=50.0), StageSettings(horizon=50)), {1: 10.0, 3: 50.0, 5: 0.0}, [1] * 6 + [2] * 3),
    ],
)
def test_a_stage_ends_after_its_own_generations_or_steps_or_by_a_score(stages, means, found):
    assert numbers(scheduled(*stages), history(8), evaluated(means)) == found


def test_the_score_that_ends_a_stage_of_a_minimised_function_is_its_value():
    options = Objective.of({"dimension": 2, "x0": 0, "minimise": True}).options
    settings = scheduled(StageSettings(score=-2.5), StageSettings(horizon=50))
    for task, shown in (("function:mine:cost", 2.5), (PLAIN.task.task, -2.5)):
        found = replace(settings, task=replace(settings.task, task=task, options=options))
        assert float(begun_stages(found, history(6), evaluated({1: -2.5}))[-1].why.split()[-1]) == shown


def test_scores_of_earlier_stages_or_unscheduled_evaluations_end_no_stage():
    settings = scheduled(StageSettings(4), StageSettings(score=50.0), StageSettings(horizon=50))
    stray = evaluated({1: 90.0, 3: 90.0, 4: 90.0, 5: 10.0, 6: 90.0})
    assert numbers(settings, history(9), stray) == [1] * 4 + [2] * 6
    assert numbers(settings, history(9), [*stray[:3], *evaluated({5: 50.0})]) == [1] * 4 + [2] * 4 + [3] * 2


RESTARTED = (
    StageSettings(generations=4, score=50.0), *[StageSettings(generations=4, score=50.0, restart=True)] * 2,
    StageSettings(horizon=50),
)  # fmt: skip


@pytest.mark.parametrize(
    ("means", "stages"),
    [
        ({1: 90.0}, [1] * 4 + [4] * 9),
        ({3: 90.0}, [1] * 4 + [2] * 4 + [3] * 4 + [4]),  # it would count from generation 6 on, in another search
        ({5: 90.0}, [1] * 4 + [2] * 4 + [4] * 5),
        ({1: 10.0, 5: 10.0, 9: 90.0}, [1] * 4 + [2] * 4 + [3] * 4 + [4]),
    ],
)
def test_a_search_that_does_not_reach_its_score_is_restarted_and_one_that_does_is_not(means, stages):
    settings = scheduled(*RESTARTED)
    assert numbers(settings, history(12), evaluated(means)) == stages
    found = begun_stages(settings, history(12), evaluated(means))
    assert [each.stage.number for each in found] == sorted(set(stages))


@pytest.mark.parametrize(
    ("means", "origin"),
    [
        ({}, None),
        ({1: 10.0, 3: 40.0, 5: 20.0, 9: 15.0, 11: 45.0}, 3),  # generation 11's is not known for certain in time
        ({1: 20.0, 5: 20.0}, 1),
        ({1: 10.0, 5: 90.0}, 5),
        ({1: 90.0, 3: 95.0}, 1),
        ({1: 10.0, 3: 95.0, 5: 90.0}, 3),
    ],
)
def test_a_new_search_after_restarts_begins_at_the_best_mean_of_them_all(means, origin):
    for last, expected in ((StageSettings(sigma0=0.2), origin), (StageSettings(horizon=50), None)):
        found = begun_stages(scheduled(*RESTARTED[:-1], last), history(12), evaluated(means))
        assert [each.origin for each in found] == [None] * (len(found) - 1) + [expected]
        assert found[-1].beginning.endswith("" if expected is None else f" from {origin}'s mean")
    last = [replace(RESTARTED[2], score=None), StageSettings(sigma0=0.2)]  # the last restart needs no score
    found = begun_stages(scheduled(*RESTARTED[:2], *last), history(12), evaluated({**means, 9: 30.0}))
    assert found[-1].origin == (9 if max(means.values(), default=0) < 30 else origin)
    plain = [replace(each, restart=False, sigma0=0.2) for each in RESTARTED]
    assert {each.origin for each in begun_stages(scheduled(*plain), history(12), evaluated(means))} == {None}


def test_later_evaluations_and_their_order_do_not_matter():
    settings = scheduled(StageSettings(score=50.0), StageSettings(horizon=50))
    for order in itertools.permutations(evaluated({1: 10.0, 3: 50.0, 5: 90.0, 7: 0.0})):
        assert stage_at(5, settings, history(9), order).stage.number == 1
        assert stage_at(6, settings, history(9), order).since == 6


@pytest.mark.parametrize(
    ("end", "required_evaluation"),
    [(StageSettings(9), [-1] * 8), (StageSettings(score=1.0), [-1, -1, -1, 1, 1, 3, 3, 5])],
    ids=["generations", "score"],
)
def test_a_generation_requires_an_evaluation_only_if_a_score_may_end_its_stage(end, required_evaluation):
    agenda, found = StageTracker(scheduled(end, StageSettings())), []
    for number in range(8):
        agenda.advance_to(number, history(number), {})
        found.append(agenda.required_evaluation(number + 1))
    assert found == required_evaluation


def test_stages_and_their_reasons_are_described():
    settings = scheduled(StageSettings(2), StageSettings(steps=15), StageSettings(score=50.0), StageSettings())
    begun = begun_stages(settings, history(9), evaluated({5: 51.25}))
    assert [each.since for each in begun] == [0, 2, 4, 8]
    assert begun[0].why == ""
    assert "20" in begun[2].why
    assert "51.25" in begun[3].why


def test_settings_and_digests_without_a_schedule_are_unchanged():
    assert '"stages"' not in PLAIN.to_json()
    assert stage_at(5, PLAIN, history(5), ()).stage.settings.task == SPEC
    written = "32b5b1f8a6bee0b22ed62a5034cdf1657709a3c7b15707ad38a792110c7c9de4"
    assert SPEC.with_overrides(horizon=SPEC.horizon).digest("score", b"x" * 32, (1,)).hex() == written
    settings = scheduled(StageSettings(3, score=5.0), StageSettings(horizon=400, racing=False))
    assert RunSettings.from_json(settings.to_json()) == settings
    assert '"stages": [{"generations": 3, "score": 5.0}, {"horizon": 400, "racing": false}]' in settings.to_json()


def test_jobs_are_named_by_vector_seed_and_the_specification_of_their_episode():
    warm = replace(PLAIN, task=replace(SPEC, temperature=1.0))
    settings = replace(warm, stages=(StageSettings(4), StageSettings(horizon=50, patience=0)))
    spec = stage_at(6, settings, history(6), ()).stage.settings.task
    assert spec == replace(SPEC, horizon=50, patience=0, temperature=1.0)
    dreams = replace(PLAIN, task=replace(SPEC, task="dream", temperature=1.0), driven=0.5)
    (stage,) = stages_of(dreams)
    specs = [stage.episode_spec(episode) for episode in range(2)]
    assert specs == [replace(dreams.task, driven=True), dreams.task]
    vectors, seeds = (b"x" * 12, b"y" * 12), (7, 8)
    identities = [hashlib.sha256(vector).digest() for vector in vectors]
    assert [*stage.job_digests(vectors, seeds)] == [
        [spec.digest("score", identity, (seed,)) for spec, seed in zip(specs, seeds, strict=True)]
        for identity in identities
    ]


SETTINGS = RunSettings(SPEC, ControllerShape(1, 3), 4, 2, 0.1, "diagonal", 1, 2, 3, confirm_episodes=8)
START = StartProvenance.of("run a", base64.b64encode(np.ones(3).tobytes()).decode(), Effort(driven=5))


def controller(**provenance):
    shape = ControllerShape(1, 3)
    return Controller(shape, np.zeros(shape.size, np.float32), "car-racing", "ab" * 32, provenance)


def test_an_older_controllers_provenance_is_derived(tmp_path):
    tiny, _ = find_controller("tiny", tmp_path)
    found = read_run_provenance(tiny)
    assert (found.generations, found.effort, found.start) == (25, Effort(dreamt=10_240_000), None)
    assert read_run_settings(tiny).task.temperature == 1.5


@pytest.mark.parametrize(
    "provenance", [{}, {RECEIPT: 1}, {RECEIPT: {"generations": -1}}, {"settings": {}, "generation": 1}]
)
def test_a_controller_without_receipt_or_a_start_with_a_wrong_hash_is_an_error(provenance):
    with pytest.raises(ControllerError):
        read_run_provenance(controller(**provenance))
    with pytest.raises(ControllerError):
        _ = replace(START, mean=START.mean[:-4]).vector


def test_effort_counts_reality_and_dream_separately_and_seeds_are_of_both_checks():
    assert validation_seed_ranges(SETTINGS) == {"evaluation": (20_000, 3), "confirmation": (40_000, 8)}
    assert validation_seed_ranges(replace(SETTINGS, evaluate_every=0, confirm_episodes=0)) == {}
    said = {930: "930", 12_345: "12.3k", 28 * 10**5: "2.8M", 17 * 10**8: "1.7G"}
    assert {steps: format_steps(steps) for steps in said} == said
    kinds = [("car-racing", "score"), ("car-racing", "evaluate"), ("dream", "score"), ("dream", "evaluate")]
    found = sum((Effort.of(task, kind, 10.0, 1e6) for task, kind in kinds), Effort.of("dream", "collect", 5, 0))
    assert (found.driven, found.judged, found.dreamt, found.steps) == (15, 20, 10, 35)
    assert found.core_hours == pytest.approx(4 / 3600)
    assert Effort.of("car-racing", "score", float("inf"), 0).driven == 2**63 - 1
    assert re.match(r"35 .*, 10 .*, 0\.00111 ", found.describe("car-racing"))
    assert re.match(r"7 .*, 0\.000278 ", Effort.of("function:m:f", "score", 7, 1e6).describe("function:m:f"))
