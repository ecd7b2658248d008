"""Tests task.py and environments.py."""

import json
import re
import sys
from textwrap import dedent

import gymnasium
import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import Continuous, Discrete
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.errors import ControllerError, UsageError
from dreamfleet.common.host import packages
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import describe_task, family_of, load_task
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.registry import find_task, known_tasks
from dreamfleet.worker.worlds.gym import environments
from dreamfleet.worker.worlds.gym.environments import ArgumentsError, make_environment
from dreamfleet.worker.worlds.gym.task import DEFAULT_MAX_STEPS
from tests.support.stuck_environments import MODULE as STUCK

CARTPOLE = "gym:CartPole-v1"


def spec(name, hidden=0, **options):
    description = describe_task(name, options)
    shape = ControllerShape(description.observations, description.outputs, hidden)
    return TaskSpec(name, "", 1000, 0, shape, options=description.options, version=description.version)


def test_a_family_is_announced_by_its_name():
    assert "gym" in known_tasks()
    assert (family_of(CARTPOLE), family_of("car-racing"), family_of("a.module:Task")) == (
        "gym", "car-racing", "a.module:Task",
    )  # fmt: skip
    assert find_task(CARTPOLE).name == CARTPOLE


@pytest.mark.parametrize(
    ("name", "observations", "outputs", "engine"),
    [
        (CARTPOLE, 4, 2, ()),
        ("gym:Pendulum-v1", 3, 1, ()),
        ("gym:LunarLander-v3", 8, 4, ("box2d", "box2d-py")),
        ("gym:CarRacing-v3", 96 * 96 * 3, 3, ("box2d", "box2d-py")),
    ],
)
def test_sizes_and_packages_are_the_environments_own(name, observations, outputs, engine):
    description = describe_task(name, {})
    assert (description.observations, description.outputs) == (observations, outputs)
    assert description.packages == ("numpy", "gymnasium", *engine)
    assert description.options == ""


@pytest.mark.parametrize(
    ("name", "observations", "outputs"),
    [
        ("gym:FrozenLake-v1", 16, 4),  # Discrete
        ("gym:Blackjack-v1", 32 + 11 + 2, 2),  # a Tuple of Discrete
        ("gym:tests.support.pixel_fakes:Gauges-v0", 3 + 2 + 4, 4),  # a Dict, and a Dict of actions
    ],
)
def test_observations_and_actions_of_any_numbers_are_flattened(name, observations, outputs):
    description = describe_task(name, {"normalise": True, "seed": 1})
    assert (description.observations, description.outputs) == (observations, outputs)
    scorer = Scorer(spec(name))
    parameters = np.random.default_rng(2).normal(size=scorer.spec.controller.size).astype(np.float32)
    scores = [scorer.score("evaluate", parameters, seed).fitness for seed in (5, 6, 5)]
    assert scores[0] == scores[2]
    scorer.close()


@pytest.mark.parametrize(
    ("keys", "observed"), [((), [0, 0, 1, 0.5, 0.25]), (("hand",), [0, 0, 1]), (("notes",), [0.5, 0.25])]
)
def test_what_is_no_number_is_left_out_and_keys_are_chosen(keys, observed):
    task = find_task("gym:tests.support.pixel_fakes:Telling-v0")
    frozen = spec(task.name, observation=keys)
    assert frozen.controller.features == len(observed)
    assert frozen.option("observation", []) == list(keys)
    with task.make_environment(Assignment(frozen)) as environment:
        assert environment.reset(seed=1)[0].tolist() == observed
        assert environment.step(np.float32([1, 0, 0]))[0].tolist() == observed
    assert task.find_standalone_script(Assignment(frozen)) is None


@pytest.mark.parametrize(
    ("environment", "keys", "named"),
    [
        ("Telling", ["hand", "mission"], "mission"),
        ("Gauges", ["radar"], "hand, speeds"),
        ("Grey", ["screen"], "screen"),
    ],
)
def test_a_key_that_is_no_number_or_not_there_is_refused(environment, keys, named):
    with pytest.raises(UsageError, match=named):
        describe_task(f"gym:tests.support.pixel_fakes:{environment}-v0", {"observation": keys})


@pytest.mark.parametrize("taken", [(0, [0]), (0, [1]), (1, [0]), (1, [1])])
def test_each_number_of_an_action_is_chosen(taken):
    numbers = (taken[0], *taken[1])  # in the order of the keys: gear, lamps
    task = find_task("gym:tests.support.pixel_fakes:Gauges-v0")
    with task.make_environment(Assignment(spec(task.name))) as environment:
        observation, _ = environment.reset(seed=1)
        assert observation.tolist() == [0, 0, 1, 0.5, 0.25, 0, 1, 0, 1]  # keys in their order: hand, speeds, switches
        info = environment.step(task.world_of(Assignment(spec(task.name))).actions.from_numbers(numbers))[4]
        assert (info["taken"]["gear"] - 1, info["taken"]["lamps"].tolist()) == taken


def test_the_environments_arguments_are_part_of_the_run():
    description = describe_task("gym:LunarLander-v3", {"environment": {"continuous": True}})
    assert (description.outputs, json.loads(description.options)) == (2, {"environment": {"continuous": True}})
    scorer = Scorer(spec("gym:LunarLander-v3", environment={"continuous": True}))
    assert isinstance(scorer.world.actions, Continuous)
    assert scorer.score("score", np.zeros(18, np.float32), 1).steps > 10
    scorer.close()


def test_a_score_is_the_environments_own_under_a_controller():
    scorer = Scorer(spec(CARTPOLE))
    parameters = np.array([0, 0, -1, -1, 0, 0, 1, 1, 0, 0], np.float32)  # pushes to the side to which the pole falls
    environment = gymnasium.make("CartPole-v1")
    observation, _ = environment.reset(seed=7)
    total, over = 0.0, False
    while not over:
        action = int(parameters[:4] @ observation < parameters[4:8] @ observation)
        observation, reward, terminated, truncated, _ = environment.step(action)
        total, over = total + reward, terminated or truncated
    assert scorer.score("evaluate", parameters, 7).fitness == total > 100
    scorer.close()


def test_observations_are_normalised_by_what_the_run_froze():
    once, again = (spec("gym:Pendulum-v1", normalise=True, seed=3) for _ in range(2))
    assert once == again
    normal = once.option("normal")
    assert len(normal["mean"]) == len(normal["deviation"]) == 3
    plain, scaled = Scorer(spec("gym:Pendulum-v1")), Scorer(once)
    parameters = np.array([0.1, -0.2, 0.3, 0.05], np.float32)
    # A controller that undoes the normalisation drives as the plain one does.
    deviation, mean = np.array(normal["deviation"]), np.array(normal["mean"])
    undone = np.array([*(parameters[:3] * deviation), parameters[3] + parameters[:3] @ mean], np.float32)
    assert scaled.score("score", undone, 5).fitness == pytest.approx(plain.score("score", parameters, 5).fitness, 1e-3)
    plain.close()
    scaled.close()


@pytest.mark.parametrize(
    ("name", "named"),
    [
        ("gym:Nothing-v0", "'Nothing-v0'"),
        ("gym:no_such_module:X-v0", "--trust no_such_module"),
        ("gym:tests.support.no_such:X-v0", r"No module named 'tests\.support\.no_such'"),
        ("gym:", "''"),
        ("gym", "gym"),
        ("gym:tests.support.pixel_fakes:Mute-v0", "Mute"),
        ("gym:tests.support.pixel_fakes:Blind-v0", "function:MODULE:NAME"),
        ("car-racing:x", "car-racing:x"),
    ],
)
def test_an_unusable_environment_is_refused_with_the_reason(name, named):
    with pytest.raises(UsageError, match=named):
        describe_task(name, {})


@pytest.mark.parametrize(
    ("name", "command"),
    [("ALE/Nothing-v5", "pip install ale-py"), ("MiniGrid-Nothing-v0", "pip install minigrid")],
)
def test_an_environment_of_a_known_package_says_how_to_install_it(name, command):
    with pytest.raises(UsageError, match=command):
        describe_task(f"gym:{name}", {})


def test_a_known_package_that_is_here_is_imported_for_its_names_alone(tmp_path, monkeypatch):
    source = """
        import gymnasium
        gymnasium.register("Here-v0", "gymnasium.envs.classic_control.cartpole:CartPoleEnv", max_episode_steps=9)
    """
    (tmp_path / "package_that_is_here.py").write_text(dedent(source))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(environments.PACKAGES, "Here-", ("here", "package_that_is_here"))
    with pytest.raises(UsageError):
        describe_task("gym:There-v0", {})
    assert "package_that_is_here" not in sys.modules
    try:
        assert describe_task("gym:Here-v0", {}).observations == 4
    finally:
        gymnasium.registry.pop("Here-v0", None)


@pytest.mark.parametrize("line", ["import gymnasium.wrappers.compatibility", "from gymnasium import no_such_name"])
def test_a_package_for_another_gymnasium_is_called_that(line, tmp_path, monkeypatch):
    (tmp_path / "for_another.py").write_text(line)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("DREAMFLEET_TRUST", "for_another")
    with pytest.raises(UsageError, match=re.escape(gymnasium.__version__)):
        describe_task("gym:for_another:It-v0", {})


def test_a_task_that_cannot_be_loaded_under_another_gymnasium_names_the_one_to_install(monkeypatch):
    monkeypatch.setattr(packages, "package_version", lambda _name: "0.28.1")
    with pytest.raises(UsageError, match=re.escape(packages.wanted_versions("gymnasium"))):
        load_task("tests.support.tasks:NoSuchTask")


def test_a_class_that_its_module_does_not_register_is_made_as_it_is():
    name = f"gym:{Strange.__module__}:Strange"
    assert describe_task(name, {}).observations == 2
    with pytest.raises(UsageError, match=name):
        load_task(name.removeprefix("gym:"))


class Strange(gymnasium.Env):
    """An environment whose arguments choose its actions, or the error that its construction raises."""

    observation_space = gymnasium.spaces.Box(-1, 1, (2,))

    def __init__(self, actions="float", fails=None, render_mode=None):
        if fails == "exit":
            raise SystemExit(3)
        if fails:
            raise RuntimeError(fails)
        self.action_space = {
            "float": gymnasium.spaces.Box(-1, 1, (1,)),
            "none": gymnasium.spaces.Box(-1, 1, (0,)),
        }[actions]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), 0.0, False, False, {}


@pytest.fixture
def strange():
    gymnasium.register("Strange-v0", entry_point=Strange)
    yield "gym:Strange-v0"
    del gymnasium.registry["Strange-v0"]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"actions": "none"}, "Box"),
        ({"actions": "?"}, "KeyError"),
        ({"fails": "boom"}, "RuntimeError: boom"),
        ({"fails": "exit"}, r"exit\(3\)"),
    ],
)
def test_any_error_while_an_environment_is_made_is_one_line(strange, arguments, named):
    with pytest.raises(UsageError, match=named):
        describe_task(strange, {"environment": arguments})


@pytest.mark.parametrize("place", ["tests.support.needy_environments:Needy-v0", f"{STUCK}:Lazy-v0"])
def test_a_missing_dependency_is_named_and_not_the_environments_own_module(place):
    with pytest.raises(UsageError) as raised:
        describe_task(f"gym:{place}", {})
    assert "'a_package_that_is_missing'" in str(raised.value)
    assert "--trust" not in str(raised.value)


def test_a_type_error_inside_a_constructor_is_not_one_of_its_arguments():
    for kind, arguments in (("Mistaken", {"size": 3}), ("HandsOn", {"size": 3})):
        with pytest.raises(UsageError) as raised:
            make_environment(f"{STUCK}:{kind}-v0", arguments)
        assert not isinstance(raised.value, ArgumentsError)
    for kind in ("Mistaken", "HandsOn"):
        with pytest.raises(ArgumentsError):
            make_environment(f"{STUCK}:{kind}-v0", {"wings": 3})


@pytest.mark.slow
def test_an_environment_without_a_time_limit_is_bounded(strange):
    assert describe_task(strange, {"normalise": True}).observations == 2
    scorer = Scorer(spec(strange))
    assert scorer.score("evaluate", np.zeros(3, np.float32), 1).steps == DEFAULT_MAX_STEPS
    scorer.close()


@pytest.mark.filterwarnings("ignore:.*latest versioned")
def test_a_run_names_the_environments_version():
    with pytest.raises(UsageError, match="gym:CartPole-v1"):
        describe_task("gym:CartPole", {})
    with pytest.raises(UsageError, match="gym:gymnasium:CartPole-v1"):
        describe_task("gym:gymnasium:CartPole", {})


def test_a_name_with_a_version_is_taken_although_the_environment_shows_that_of_another(monkeypatch):
    inside = gymnasium.make("CartPole-v1")
    monkeypatch.setattr("dreamfleet.worker.worlds.gym.task.make_environment", lambda *_: inside)
    assert describe_task("gym:MyCart-v0", {}).observations == 4


def test_unknown_options_and_arguments_are_refused():
    with pytest.raises(UsageError, match=r"wings.* environment, observation, normalise"):
        describe_task(CARTPOLE, {"wings": 2})
    with pytest.raises(UsageError, match="wings"):
        describe_task(CARTPOLE, {"environment": {"wings": 2}})


def test_a_controller_of_other_outputs_is_refused():
    with pytest.raises(ControllerError):
        Scorer(TaskSpec(CARTPOLE, "", 100, 0, ControllerShape(4, 3)))


def test_the_first_of_equal_outputs_is_chosen_and_actions_start_at_the_spaces_start():
    assert Discrete(3, first=2).to_action(np.array([0.0, 1.0, 1.0])) == 3
    assert Continuous.between([0, -2], [1, 2]).to_action(np.array([0.0, 100.0])) == pytest.approx([0.5, 2.0])
