"""Any gymnasium environment with pictures as a world of data sets and world models."""

import json
from importlib.util import find_spec

import gymnasium
import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import one_hot
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.common.errors import BundleError, RefusedError, UsageError
from dreamfleet.common.host.trusted_modules import VARIABLE
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.policy import DriverPolicy
from dreamfleet.worker.tasks.recordable import RecordableTask
from dreamfleet.worker.tasks.registry import check_world_allowed, find_task, task_of
from tests.support import pixel_fakes
from tests.support.bundles import write_world_bundle
from tests.support.pixel_world import DODGE
from tests.support.world_contract import check_world

LONGEST = 2**53 - 1
GREY = f"gym:{pixel_fakes.MODULE}:Grey-v0"


def fake(kind, **options):
    return find_task(f"gym:{pixel_fakes.MODULE}:{kind}-v0").with_options(json.dumps(options))


def needs_package(name):
    return pytest.mark.skipif(find_spec(name) is None, reason=f"the package {name} is not installed")


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("InDict", {}),
        ("InDict", {"observation": "screen", "size": 96}),
        ("InTwo", {"observation": "map"}),
        ("Grey", {"crop": "8:48,0:40"}),
        ("Floats", {"skip": 2}),
        ("Buttons", {"difference": True}),
        ("Switches", {}),
        ("BothEnds", {}),
        ("Unseen", {"observation": "render"}),
        ("ChannelsFirst", {"crop": "8:48,0:40"}),
        ("ChannelsFirst", {"observation": "render"}),
        ("Stacked", {}),
        ("Stacked", {"observation": "all"}),
    ],
)
def test_an_environment_with_pictures_keeps_the_contract(kind, options):
    task = fake(kind, **options)
    check_world(task)
    assert json.loads(task.options or "{}") == options
    assert task.world.packages[:2] == ("numpy", "gymnasium")
    assert task.world.frames_per_second == 10 // options.get("skip", 1)
    assert task.world.horizon == 200 // options.get("skip", 1)


def test_channels_first_the_last_of_a_stack_and_what_is_drawn_are_the_same_picture():
    first, drawn, last, plain = (
        drive(task, 4)[0].seen
        for task in (
            fake("ChannelsFirst"),
            fake("ChannelsFirst", observation="render"),
            fake("Stacked"),
            fake("Unseen", observation="render"),
        )
    )
    assert np.array_equal(first, plain)
    assert np.array_equal(drawn, plain)
    assert np.array_equal(last[..., 0], plain[..., 0])


def test_all_frames_of_a_stack_are_seen_where_they_are_wanted():
    seen = drive(fake("Stacked", observation="all"), 4)[0].seen
    assert not seen[:32].any()
    assert not seen[32:, :32].any()
    assert seen[32:, 32:].any()


def test_the_pixel_world_is_one_without_a_line_of_code():
    task = find_task(DODGE).with_options("")
    check_world(task)
    assert task.world.actions == one_hot(3)
    assert list(task.preprocessings) == ["box-64"]


@pytest.mark.parametrize(
    ("kind", "outputs", "action", "taken"),
    [("Buttons", 5, [0, 1, 0, 0, 1], [2, 1]), ("Switches", 4, [1, 0], [1, 0]), ("Floats", 1, [0.5], [0.5])],
)
def test_an_action_is_a_vector_that_the_simulator_gets_as_its_own(kind, outputs, action, taken):
    task = fake(kind)
    assert (task.world.actions.outputs, task.world.actions.actions) == (outputs, len(action))
    with task.make_recorded("box-64") as environment:
        environment.reset(seed=1)
        assert np.array_equal(environment.step(np.float32(action))[4]["taken"], taken)


@pytest.mark.parametrize(
    ("name", "options", "named"),
    [
        ("CartPole-v1", {}, "--observation.* render"),
        (f"{pixel_fakes.MODULE}:InTwo-v0", {}, "--observation.* map, screen, render"),
        (f"{pixel_fakes.MODULE}:InTwo-v0", {"observation": "radar"}, "'radar'"),
        (f"{pixel_fakes.MODULE}:Grey-v0", {"observation": "screen"}, "'screen'"),
        (f"{pixel_fakes.MODULE}:Grey-v0", {"observation": "all"}, "--observation.* render"),
        (f"{pixel_fakes.MODULE}:Stacked-v0", {"observation": "screen"}, "--observation.* all, render"),
        (f"{pixel_fakes.MODULE}:Board-v0", {}, "--observation.* render"),
        (f"{pixel_fakes.MODULE}:Grey-v0", {"crop": "0:49,0:40"}, "48"),
        (f"{pixel_fakes.MODULE}:Grey-v0", {"crop": "0:1,0:1"}, "8"),
        (f"{pixel_fakes.MODULE}:Grey-v0", {"environment": {"render_mode": "human"}}, "Grey-v0"),
        ("CartPole-v1", {"observation": "render", "environment": {"wings": 2}}, "wings"),
        ("no_such_module:X-v0", {}, "--trust no_such_module"),
        ("CartPole-v1", {"environment": {"inner": "no_such_module:X-v0"}}, "--trust no_such_module"),
    ],
)
def test_an_environment_without_such_pictures_is_refused_with_the_reason(name, options, named):
    with pytest.raises(UsageError, match=named):
        find_task(f"gym:{name}").with_options(json.dumps(options)).world  # noqa: B018


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("{", r"\{"),
        ("[]", r"\[\]"),
        ('{"zoom": 2}', "zoom.* environment, observation, crop, size, skip, difference"),
        ('{"size": 32}', "32"),
        ('{"skip": 0}', r"\$\.skip"),
        ('{"skip": true}', r"\$\.skip"),
        ('{"crop": "1:2"}', "1:2"),
        ('{"environment": 5}', r"\$\.environment"),
        ("[" * 100_000, "environment"),
    ],
)
def test_unknown_and_wrong_options_are_refused(text, named):
    with pytest.raises(UsageError, match=named):
        find_task(DODGE).with_options(text)


def test_a_verbs_arguments_become_the_options_that_differ_from_their_defaults():
    task = find_task(DODGE)
    assert task.parse_options({"crop": None, "size": 64, "skip": 1, "environment": {}, "episodes": 7}) == ""
    given = {"crop": "0:40,0:40", "size": 96, "difference": True, "environment": {"b": 1, "a": 2}}
    text = task.parse_options(given)
    assert text == '{"crop": "0:40,0:40", "difference": true, "environment": {"a": 2, "b": 1}, "size": 96}'
    assert list(task.with_options(text).preprocessings) == ["box-96-0:40,0:40-difference"]


def test_a_task_is_made_once_for_each_environment_and_options():
    one = fake("Grey", size=64)
    assert one is fake("Grey")
    assert one.world is fake("Grey").world
    assert one is not fake("Grey", size=96)


def test_a_parts_picture_is_that_of_the_preprocessing():
    for options in ({"crop": "8:48,0:40"}, {"difference": True}):
        task = fake("InDict", **options)
        (preprocessing,) = task.preprocessings.values()
        seen = gymnasium.make(f"{pixel_fakes.MODULE}:InDict-v0").reset(seed=4)[0]["screen"]
        observed = task.make_recorded(preprocessing.name).reset(seed=4)[0]
        assert np.array_equal(preprocessing.picture(seen), observed)


def drive(task, seed):
    (name,) = task.preprocessings
    policy = DriverPolicy(task.drivers["held"](np.random.default_rng(1)))
    with task.make_recorded(name) as environment:
        return list(run_episode(environment, policy, EpisodeConfig(seed, 1000)))


def pictures(moments):
    return [moment.seen.tobytes() for moment in moments]


def test_the_black_picture_of_an_end_is_never_seen():
    for seed in range(10):
        last = drive(fake("InDict"), seed)[-1]
        assert last.terminal
        assert last.seen.any()


def test_a_limit_is_no_death_whatever_the_environment_says():
    ends = [drive(fake("BothEnds"), seed)[-1] for seed in range(30)]
    assert {(each.terminal, each.step == 25) for each in ends} == {(True, False), (False, True)}
    assert all(each.ended for each in ends)


def test_an_environment_that_observes_what_it_draws_depends_on_what_draws():
    packages = find_task("gym:CartPole-v1").with_options('{"observation": "render"}').world.packages
    assert "pygame-ce" in packages
    assert "pygame-ce" not in fake("InDict").world.packages


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    """A random world model of the grey world, which an action is held for two steps in."""
    task = find_task(GREY).with_options('{"skip": 2}')
    facts = task.world.facts(RewardFacts("survival"), EndRule(), task.options)
    return write_world_bundle(tmp_path_factory.mktemp("grey") / "grey.zip", facts, GREY)


def test_controllers_are_scored_in_the_world_of_their_world_models_options(bundle):
    size = bundle.controller_shape.size
    assert bundle.controller_shape.actions == 3
    spec = TaskSpec(GREY, bundle.sha256, 30, 0)
    scorer = Scorer(spec, bundle)
    parameters = np.random.default_rng(1).normal(0, 1, size).astype(np.float32)
    scores = [scorer.score("score", parameters, seed) for seed in (LONGEST, 5, LONGEST)]
    assert scores[0] == scores[2]
    assert scores[1].fitness in (2 * scores[1].steps, 2 * scores[1].steps - 1)
    score, rollout = scorer.collect(parameters, LONGEST)
    assert score == scores[0]
    assert rollout.arrays()["action"].shape == (score.steps, 3)
    assert rollout.arrays()["picture"].shape == (score.steps, 64, 64, 3)
    scorer.close()


def test_a_worker_scores_in_a_world_models_module_only_if_that_was_named(bundle):
    check_world_allowed(bundle, ("dream", "gym", GREY))
    with pytest.raises(RefusedError) as refused:
        check_world_allowed(bundle, ("dream", "gym"))
    assert refused.value.flag == ("--task", GREY)


def test_a_task_without_options_makes_no_environment_when_it_is_asked_for_pictures():
    assert not isinstance(find_task("gym:Nothing-v0"), RecordableTask)
    assert find_task("gym:Nothing-v0").with_options("").options == ""


def test_a_world_model_of_other_pictures_is_refused(bundle):
    other = find_task(GREY).with_options('{"size": 96}')
    with pytest.raises(BundleError, match=r"pictures 'box-64' \(64, 64, 3\); gym:.*Grey-v0 gives 'box-96'"):
        other.make_environment(Assignment.of(GREY, bundle))


def test_videos_are_of_the_environments_own_pictures(bundle):
    assignment = Assignment.of(GREY, bundle)
    with task_of(bundle).make_evaluation_environment(assignment, "rgb_array") as environment:
        assert environment.reset(seed=1)[0].shape == (64, 64, 3)
        assert environment.render().shape == (48, 40)
    drawn = fake("Unseen", observation="render")
    with pytest.raises(UsageError):
        drawn._open("human")


@needs_package("minigrid")
def test_minigrid(monkeypatch):
    monkeypatch.setenv(VARIABLE, "minigrid")
    task = find_task("gym:minigrid:MiniGrid-Dynamic-Obstacles-8x8-v0")
    with pytest.raises(UsageError, match="--observation"):
        task.with_options("").world  # noqa: B018
    seen = task.with_options('{"environment": {"agent_pov": true, "tile_size": 8}, "observation": "render"}')
    check_world(seen)
    assert "minigrid" in seen.world.packages
    assert seen.world.action_names == ("left", "right", "forward")


@needs_package("ale_py")
def test_the_arcade_learning_environment(monkeypatch):
    monkeypatch.setenv(VARIABLE, "ale_py")
    task = find_task("gym:ale_py:ALE/Pong-v5").with_options('{"difference": true, "skip": 2}')
    check_world(task, steps=120)  # the first ball takes its time, and seeds differ in which actions stick
    assert "ale-py" in task.world.packages
    assert task.world.action_names == ("NOOP", "FIRE", "RIGHT", "LEFT", "RIGHTFIRE", "LEFTFIRE")
