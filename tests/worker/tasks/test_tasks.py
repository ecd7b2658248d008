"""What tasks offer, and how they are found by name.

Tests api.py, batches.py, model_free_policies.py, common/protocol/tasks.py and worker/scoring/scorer.py.
"""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from dreamfleet import Bundle, Scorer, TaskSpec
from dreamfleet.common.artifacts.car_racing_variants import FACTS, Variant
from dreamfleet.common.errors import BundleError, ControllerError, UsageError
from dreamfleet.common.protocol.tasks import is_self_describing
from dreamfleet.worker.scoring.episode import run_episode, score
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.registry import find_task
from tests.support.variants import VARIANTS


@pytest.mark.parametrize("name", ["os:abort", "sys:exit", "tests.support.tasks:steps_made"])
def test_what_is_no_class_is_never_called_as_a_task(name):
    with pytest.raises(UsageError):
        find_task(name)


@pytest.mark.parametrize(
    ("name", "named"),
    [
        ("moon", "car-racing"),
        ("CarRacing-v3", "car-racing"),
        ("carracing", "car-racing"),
        ("car-racin", "car-racing"),
        ("LunarLander-v3", "gym.LunarLander-v3"),
        ("tests.support.tasks:Moon", "Moon"),
        ("no.such:Task", "no"),
    ],
)
def test_an_unknown_task_is_an_error_that_says_which_there_are(name, named):
    with pytest.raises(UsageError, match=named):
        find_task(name)


@pytest.mark.parametrize("name", ["Field-v0", "FieldOfThisTest"])
def test_a_name_of_an_environment_without_its_family_is_offered_with_it(name, monkeypatch):
    monkeypatch.setitem(gymnasium.registry, "FieldOfThisTest", None)
    with pytest.raises(UsageError, match=f"gym:tests.support.tasks:{name}") as refused:
        is_self_describing(f"tests.support.tasks:{name}")
    assert "--bundle" not in str(refused.value), "its module is here"
    with pytest.raises(UsageError, match=f"gym:tests.support.tasks:{name}"):
        find_task(f"tests.support.tasks:{name}")


@pytest.mark.parametrize("task", ["car-racing", "dream"])
@pytest.mark.parametrize(
    "change", [{"task": "moon"}, {"preprocessing": "none"}, {"preprocessing": "raw-96"}, {"picture": (96, 96, 3)}]
)
def test_a_bundle_of_another_task_or_of_pictures_that_it_does_not_give_is_refused(random_bundle, task, change):
    manifest, found = replace(random_bundle.manifest, world=FACTS, **change), find_task(task)
    bundle = Bundle(random_bundle.path, random_bundle.sha256, manifest)
    asked = task == "dream" and "task" in change  # the dream asks the bundle's own world
    named = "moon" if asked else f"'{manifest.task}' .*'{manifest.preprocessing}'"
    for make in (found.make_environment, found.make_evaluation_environment, found.make_policy):
        with pytest.raises(UsageError if asked else BundleError, match=named):
            make(Assignment.of(task, bundle))


def test_a_job_is_scored_with_the_controller_shape_of_its_run(random_bundle):
    shape = random_bundle.shape_of("z", 4)
    scorer = Scorer(TaskSpec("car-racing", random_bundle.sha256, 5, 0, shape), random_bundle)
    assert scorer.score("score", np.zeros(shape.size, np.float32), 3).steps == 5
    with pytest.raises(ControllerError, match="867 parameters"):
        scorer.score("score", np.zeros(867, np.float32), 3)


def varied(bundle, task="car-racing", horizon=5, **named):
    variant = Variant(**named)
    shape = bundle.shape_of("zh", 0, variant)
    spec = TaskSpec(task, bundle.sha256, horizon, 0, shape, options=variant.options, version=variant.version)
    return spec, np.random.default_rng(1).normal(0, 0.1, shape.size).astype(np.float32)


def judged(spec, bundle, vector, episode_config):
    task, assignment = find_task(spec.task), Assignment(spec, bundle)
    judge = task.make_evaluation_environment(assignment)
    return score(judge, task.make_policy(assignment), vector, episode_config)


@pytest.mark.parametrize("name", VARIANTS)
def test_a_job_is_scored_with_the_variant_of_its_run(random_bundle, name):
    spec, vector = varied(random_bundle, **vars(VARIANTS[name]))
    scorer = Scorer(spec, random_bundle)
    score = scorer.score("score", vector, 3)
    assert scorer.score("score", vector, 3) == score
    assert judged(spec, random_bundle, vector, scorer.episode_config("score", 3)) == score


def test_only_candidates_pay_for_time_and_for_steps_off_the_road(random_bundle):
    costs = {"offroad_cost": 2.0, "time_cost": 0.5}
    (plain, vector), (dear, _) = (varied(random_bundle, horizon=150, **each) for each in ({}, costs))
    vector = np.zeros_like(vector)
    vector[-3:] = 1, 2, -1  # gas, and always to one side
    dream = varied(random_bundle, "dream", horizon=150, **costs)[0]
    scorers = [Scorer(each, random_bundle) for each in (plain, dear, dream)]
    free, paid = (each.score("score", vector, 3) for each in scorers[:2])
    assert free.steps == paid.steps
    assert 2 <= free.fitness - paid.fitness - 0.5 * 150 <= 200
    for kind in ("evaluate", "collect"):
        assert scorers[1].episode_config(kind, 3) == scorers[0].episode_config(kind, 3)
    assert judged(dear, random_bundle, vector, scorers[1].episode_config("score", 3)) == paid
    assert scorers[2].score("score", vector, 3, spec=dream.with_overrides(driven=True)) == paid


def test_a_lap_that_is_over_costs_no_more_time(random_bundle):
    episode_config = Scorer(varied(random_bundle, time_cost=0.5)[0], random_bundle).episode_config("score", 3)
    assert (episode_config.time_cost, episode_config.finish) == (0.5, "lap_finished")
    environment = find_task("car-racing").make_environment(Assignment.of("car-racing", random_bundle))

    class HomeAtOnce:
        """Moves the lap's end under the car."""

        def act(self, _observation):
            environment.unwrapped.tile_visited_count = len(environment.unwrapped.track)
            return np.zeros(3, np.float32)

    *_, last = run_episode(environment, HomeAtOnce(), episode_config)
    assert last.ended
    assert last.info["lap_finished"]


def test_a_variant_is_another_version_of_the_task_and_is_dreamt_too(random_bundle):
    spec, vector = varied(random_bundle, "dream", 20, **vars(VARIANTS["all"]))
    scorer, jobs = Scorer(spec, random_bundle), [("score", vector, 3), ("score", -vector, 3)]
    assert scorer.score_all(jobs, lambda _: None)[0] == scorer.score(*jobs[0])
    assert (scorer.world.actions, spec.version) == (VARIANTS["all"].controls, 2)
    with pytest.raises(UsageError, match="dream"):
        Scorer(replace(spec, version=1), random_bundle)


@pytest.mark.parametrize(("task", "horizons"), [("dream", (20, 7, 20)), ("car-racing", (4, 2, 4))])
def test_a_group_is_scored_with_its_stages_horizon(random_bundle, task, horizons):
    spec = TaskSpec(task, random_bundle.sha256, horizons[0], 0)
    jobs = [("score", np.random.default_rng(1).normal(size=867).astype(np.float32), seed) for seed in (1, 2)]
    scorer = Scorer(spec, random_bundle)
    for horizon in horizons:
        scores = scorer.score_all(jobs, lambda _: None, spec.with_overrides(horizon=horizon))
        assert max(each.steps for each in scores) <= horizon
        assert scores == Scorer(spec.with_overrides(horizon=horizon), random_bundle).score_all(jobs, lambda _: None)


def test_evaluations_ignore_a_stages_horizon_and_patience(random_bundle):
    spec = TaskSpec("car-racing", random_bundle.sha256, 1000, 0)
    scorer, stage = Scorer(spec, random_bundle), spec.with_overrides(horizon=300, patience=40)
    configs = [scorer.episode_config(kind, 5, stage) for kind in ("score", "collect")]
    assert [(each.horizon, each.patience) for each in configs] == [(300, 40)] * 2
    assert scorer.episode_config("evaluate", 5, stage) == scorer.episode_config("evaluate", 5)
