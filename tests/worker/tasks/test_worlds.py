"""Worlds that are recorded under options, and bundles that describe them.
Tests recordable.py, world.py and worker/worlds/car_racing/task.py."""

import pytest

from dreamfleet import Scorer, TaskSpec
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.common.errors import BundleError, RefusedError, UsageError
from dreamfleet.worker.tasks.api import Assignment, Continuous, Discrete, Mirror, World, one_hot
from dreamfleet.worker.tasks.recordable import RecordableTask, TaskWithBeginnings, TaskWithOptions
from dreamfleet.worker.tasks.registry import (
    check_world_allowed,
    find_scored_task,
    find_task,
    find_world,
    preprocessing_for,
    task_of,
)
from tests.support import pixel_fakes
from tests.support.bundles import write_world_bundle
from tests.support.variants import vectors

GREY = f"gym:{pixel_fakes.MODULE}:Grey-v0"
OPTIONS = '{"skip": 2}'  # the environment has 10 frames a second


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    """A random world model of the grey world, which an action is held for two steps in."""
    facts = find_world(GREY, OPTIONS).world.facts(RewardFacts("survival"), EndRule("drawn"), OPTIONS)
    return write_world_bundle(tmp_path_factory.mktemp("grey") / "grey.zip", facts, GREY)


def test_a_world_with_options_is_found_under_them_and_another_takes_none():
    for name in (GREY, "gym:Nothing-v0"):  # none is made only to see whether it has pictures
        assert not isinstance(find_task(name), RecordableTask)
    assert isinstance(find_task(GREY), TaskWithOptions)
    assert not isinstance(find_task("car-racing"), TaskWithOptions)
    assert isinstance(find_world("car-racing"), TaskWithBeginnings)
    assert not isinstance(find_world(GREY), TaskWithBeginnings)
    rates = [find_world(GREY, options).world.frames_per_second for options in ("", OPTIONS)]
    assert rates == [10, 5]
    with pytest.raises(UsageError, match=r"'car-racing'"):
        find_world("car-racing", OPTIONS)
    with pytest.raises(UsageError):
        find_world("dream")


def test_a_bundles_task_has_the_options_that_it_was_recorded_under(bundle, random_bundle):
    assert task_of(bundle).options == find_scored_task(GREY, bundle).options == OPTIONS
    assert find_scored_task("dream", bundle).name == "dream"
    assert find_scored_task("gym:CartPole-v1", None).name == "gym:CartPole-v1"
    assert task_of(random_bundle).name == "car-racing"


def test_a_bundle_of_other_pictures_is_refused(bundle, random_bundle):
    assert preprocessing_for(bundle, task_of(bundle)).size == 64
    with pytest.raises(BundleError, match=r"'car-racing'.*'box-64'"):
        preprocessing_for(random_bundle, find_world(GREY))
    with pytest.raises(BundleError, match=r"'box-64' \(64, 64, 3\).*Grey-v0 .*'box-96'"):
        find_world(GREY, '{"size": 96}').make_environment(Assignment.of(GREY, bundle))


def test_a_worker_scores_in_a_world_models_module_only_if_that_was_named(bundle):
    check_world_allowed(bundle, ("dream", "gym", GREY))
    with pytest.raises(RefusedError) as refused:
        check_world_allowed(bundle, ("dream", "gym"))
    assert refused.value.flag == ("--task", GREY)


def test_videos_are_of_the_environments_own_pictures(bundle):
    with task_of(bundle).make_evaluation_environment(Assignment.of(GREY, bundle), "rgb_array") as environment:
        assert environment.reset(seed=1)[0].shape == (64, 64, 3)
        assert environment.render().shape == (48, 40)
    with pytest.raises(UsageError):
        find_world(f"gym:{pixel_fakes.MODULE}:Unseen-v0", '{"observation": "render"}')._open("human")


@pytest.mark.parametrize("options", ["", '{"decide_every": 3}', '{"feedback": "last"}'])
def test_a_world_is_scored_by_its_world_model_under_its_options(bundle, options):
    driving = bundle.with_options(None, options)
    spec = TaskSpec(GREY, bundle.sha256, 30, 0, driving.controller_shape, options=options)
    scorer, again = (Scorer(spec, bundle) for _ in range(2))
    (parameters,) = vectors(driving, 1, scale=1.0)
    score = scorer.score("score", parameters, seed=2**53 - 1)
    assert again.score("score", parameters, seed=2**53 - 1) == score != again.score("score", parameters, seed=5)
    assert score.fitness in (2 * score.steps, 2 * score.steps - 1)
    collected, rollout = scorer.collect(parameters, 2**53 - 1)
    assert collected == score
    assert rollout.arrays()["action"].shape == (score.steps, 3)
    assert rollout.arrays()["picture"].shape == (score.steps, 64, 64, 3)


def test_a_worlds_facts_are_what_the_coordinator_needs():
    world = World(one_hot(3), ("numpy", "onnxruntime"), horizon=50, score_word="game", marks=(10,))
    facts = world.facts(RewardFacts("survival"), EndRule("drawn"), OPTIONS)
    assert facts.actions == one_hot(3)
    assert (facts.horizon, facts.frames_per_second, facts.packages) == (50, 30, ("numpy", "onnxruntime"))
    assert (facts.score_word, facts.marks, facts.options) == ("game", (10.0,), OPTIONS)
    with pytest.raises(UsageError, match="one_hot"):
        World(Discrete(3)).facts(RewardFacts(), EndRule())


@pytest.mark.parametrize("actions", [one_hot(2), Discrete(3), Continuous.between([-1], [1])])
def test_a_mirror_of_another_number_of_actions_makes_no_world(actions):
    with pytest.raises(UsageError):
        World(actions, mirror=Mirror((0, 2, 1), (1, 1, 1)))
