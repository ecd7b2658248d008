"""Any gymnasium environment as a task, and with pictures as a world of data sets and world models.
Tests environments.py, pixels.py, spaces.py, task.py and common/host/foreign_code.py."""

import json
import re
import signal
import subprocess
import sys
from dataclasses import replace
from itertools import product
from math import prod
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from dreamfleet import Continuous, ControllerShape, Scorer, TaskSpec
from dreamfleet.common.errors import ControllerError, UsageError
from dreamfleet.common.host import packages
from dreamfleet.common.host.processes import command
from dreamfleet.common.protocol.tasks import describe_task, load_task
from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.model_free_policies import DriverPolicy
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worlds.gym import environments
from dreamfleet.worker.worlds.gym.environments import DEFAULT_MAX_STEPS, ArgumentsError, make_environment
from dreamfleet.worker.worlds.gym.spaces import make_converter, vector_actions
from dreamfleet.worker.worlds.gym.task import GymTask
from tests.support import pixel_fakes, tasks
from tests.support.environments import ACTIONS, STRICT
from tests.support.pixel_world import DODGE
from tests.support.processes import DEADLINE, environment, runs, until
from tests.support.specs import described_spec
from tests.support.stuck_environments import MODULE as STUCK
from tests.support.world_contract import check_world

CARTPOLE, FAKES = "gym:CartPole-v1", "gym:tests.support.pixel_fakes"


@pytest.mark.parametrize(
    ("name", "arguments", "observations", "outputs", "engine"),
    [
        (CARTPOLE, {}, 4, 2, ()),
        ("gym:Pendulum-v1", {}, 3, 1, ()),
        ("gym:LunarLander-v3", {}, 8, 4, ("box2d", "box2d-py")),
        ("gym:LunarLander-v3", {"continuous": True}, 8, 2, ("box2d", "box2d-py")),
        ("gym:CarRacing-v3", {}, 96 * 96 * 3, 3, ("box2d", "box2d-py")),
    ],
)
def test_sizes_and_packages_are_the_environments_own(name, arguments, observations, outputs, engine):
    description = describe_task(name, {"environment": arguments})
    assert (description.observations, description.outputs) == (observations, outputs)
    assert description.packages == ("numpy", "gymnasium", *engine)
    assert json.loads(description.options or "{}") == ({"environment": arguments} if arguments else {})
    scorer = Scorer(described_spec(name, 20, environment=arguments))
    assert scorer.score("score", np.zeros(scorer.spec.controller.size, np.float32), 1).steps > 5


@pytest.mark.parametrize(
    ("kind", "keys", "observed"),
    [
        ("Telling", (), [0, 0, 1, 0.5, 0.25]),
        ("Telling", ("hand",), [0, 0, 1]),
        ("Telling", ("notes",), [0.5, 0.25]),
        ("Gauges", (), [0, 0, 1, 0.5, 0.25, 0, 1, 0, 1]),  # in the order of the keys: hand, speeds, switches
    ],
)
def test_what_is_no_number_is_left_out_keys_are_chosen_and_so_is_each_number_of_an_action(kind, keys, observed):
    frozen = described_spec(f"{FAKES}:{kind}-v0", observation=keys)
    task, assignment = find_task(frozen.task), Assignment(frozen)
    assert frozen.controller.features == len(observed)
    assert frozen.option("observation", []) == list(keys)
    with task.make_environment(assignment) as environment:
        assert environment.reset(seed=1)[0].tolist() == observed
        for gear, lamps in product((0, 1), repeat=2):
            action = task.world_of(assignment).actions.from_numbers((gear, lamps))
            found, *_, info = environment.step(action)
            assert found.tolist() == observed
            assert (info["taken"]["gear"] - 1, info["taken"]["lamps"].tolist()) == (gear, [lamps])
    assert task.find_standalone_script(assignment) is None


def test_a_score_is_the_environments_own_under_a_controller():
    scorer = Scorer(described_spec(CARTPOLE))
    parameters = np.array([0, 0, -1, -1, 0, 0, 1, 1, 0, 0], np.float32)  # pushes to the side to which the pole falls
    environment = gymnasium.make("CartPole-v1")
    observation, _ = environment.reset(seed=7)
    total, over = 0.0, False
    while not over:
        action = int(parameters[:4] @ observation < parameters[4:8] @ observation)
        observation, reward, terminated, truncated, _ = environment.step(action)
        total, over = total + reward, terminated or truncated
    assert scorer.score("evaluate", parameters, 7).fitness == total > 100


def test_observations_are_normalised_by_what_the_run_froze():
    once, again = (described_spec("gym:Pendulum-v1", normalise=True, seed=3) for _ in range(2))
    assert once == again
    mean, deviation = (np.array(once.option("normal")[name]) for name in ("mean", "deviation"))
    assert len(mean) == len(deviation) == 3
    plain, scaled = Scorer(described_spec("gym:Pendulum-v1")), Scorer(once)
    parameters = np.array([0.1, -0.2, 0.3, 0.05], np.float32)
    # A controller that undoes the normalisation drives as the plain one does.
    undone = np.array([*(parameters[:3] * deviation), parameters[3] + parameters[:3] @ mean], np.float32)
    assert scaled.score("score", undone, 5).fitness == pytest.approx(plain.score("score", parameters, 5).fitness, 1e-3)


@pytest.mark.parametrize(
    ("name", "options", "named"),
    [
        ("gym:Nothing-v0", {}, "'Nothing-v0'"),
        ("gym:ALE/Nothing-v5", {}, "pip install ale-py"),
        ("gym:MiniGrid-Nothing-v0", {}, "pip install minigrid"),
        ("gym:no_such_module:X-v0", {}, "--trust no_such_module"),
        ("gym:tests.support.no_such:X-v0", {}, r"No module named 'tests\.support\.no_such'"),
        ("gym:", {}, "''"),
        ("gym", {}, "gym"),
        ("car-racing:x", {}, "car-racing:x"),
        ("gym:CartPole", {}, "gym:CartPole-v1"),  # a run names the environment's version
        ("gym:gymnasium:CartPole", {}, "gym:gymnasium:CartPole-v1"),
        (f"{FAKES}:Mute-v0", {}, "Mute"),
        (f"{FAKES}:Blind-v0", {}, "function:MODULE:NAME"),
        (f"{FAKES}:Telling-v0", {"observation": ["hand", "mission"]}, "mission"),  # no number
        (f"{FAKES}:Gauges-v0", {"observation": ["radar"]}, "hand, speeds"),
        (f"{FAKES}:Grey-v0", {"observation": ["screen"]}, "screen"),
        (CARTPOLE, {"wings": 2}, "wings.* environment, observation, normalise"),
        (CARTPOLE, {"environment": {"wings": 2}}, "wings"),
        (CARTPOLE, {"environment": 5}, "environment"),
        (CARTPOLE, {"observation": 5}, "observation"),
        (CARTPOLE, {"normalise": True, "seed": "x"}, "seed"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*latest versioned")
def test_what_an_environment_cannot_be_is_refused_with_the_reason(name, options, named):
    with pytest.raises(UsageError, match=named):
        describe_task(name, options)


@pytest.mark.parametrize("options", [
    "not json", "[1]", "[" * 100_000, '{"environment": 5}', '{"environment": [1]}', '{"observation": 5}',
    '{"observation": [5]}', '{"normal": 5}', '{"normal": {"mean": [0.0]}}', '{"normal": {"mean": 0, "deviation": "1"}}',
])  # fmt: skip
def test_options_of_a_file_that_the_world_cannot_have_are_refused(options):
    assignment = Assignment(replace(described_spec(CARTPOLE), options=options), None)
    with pytest.raises(UsageError, match=re.escape(f"{options!r:.200}")):
        find_task(CARTPOLE).world_of(assignment)


def test_a_known_package_that_is_here_is_imported_for_its_names_alone(tmp_path, monkeypatch):
    entry = "gymnasium.envs.classic_control.cartpole:CartPoleEnv"
    (tmp_path / "package_that_is_here.py").write_text(f"import gymnasium; gymnasium.register('Here-v0', '{entry}')")
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
def test_a_package_for_another_gymnasium_is_called_that_and_so_is_another_gymnasium(line, tmp_path, monkeypatch):
    (tmp_path / "for_another.py").write_text(line)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("DREAMFLEET_TRUST", "for_another,tests.support")
    with pytest.raises(UsageError, match=re.escape(gymnasium.__version__)):
        describe_task("gym:for_another:It-v0", {})
    monkeypatch.setattr(packages, "package_version", lambda _name: "0.28.1")
    with pytest.raises(UsageError, match=re.escape(packages.wanted_versions("gymnasium"))):
        load_task("tests.support.tasks:NoSuchTask")


def test_a_class_that_its_module_does_not_register_is_made_as_it_is():
    name = f"{tasks.MODULE}:ToyEnvironment"
    assert describe_task(f"gym:{name}", {}).observations == 1
    with pytest.raises(UsageError, match=f"gym:{name}"):
        load_task(name)


def without_actions(**_more):
    environment = tasks.ToyEnvironment()
    environment.action_space = gymnasium.spaces.Box(-1, 1, (0,))
    return environment


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (without_actions, "Box"),
        (lambda **_more: 1 / 0, "ZeroDivisionError: division by zero"),
        (lambda **_more: sys.exit(3), r"\b3\b"),
    ],
)
def test_any_error_while_an_environment_is_made_is_one_line(monkeypatch, make, named):
    monkeypatch.setitem(gymnasium.registry, "Strange-v0", EnvSpec("Strange-v0", entry_point=make))
    with pytest.raises(UsageError, match=named) as raised:
        describe_task("gym:Strange-v0", {})
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("place", ["tests.support.needy_environments:Needy-v0", f"{STUCK}:Lazy-v0"])
def test_a_missing_dependency_is_named_and_not_the_environments_own_module(place):
    with pytest.raises(UsageError) as raised:
        describe_task(f"gym:{place}", {})
    assert "'a_package_that_is_missing'" in str(raised.value)
    assert "--trust" not in str(raised.value)


@pytest.mark.parametrize("kind", ["Mistaken", "HandsOn"])
def test_a_type_error_inside_a_constructor_is_not_one_of_its_arguments(kind):
    with pytest.raises(UsageError) as raised:
        make_environment(f"{STUCK}:{kind}-v0", {"size": 3})
    assert not isinstance(raised.value, ArgumentsError)
    with pytest.raises(ArgumentsError):
        make_environment(f"{STUCK}:{kind}-v0", {"wings": 3})


@pytest.mark.slow
def test_an_environment_without_a_time_limit_is_bounded():
    endless = described_spec("gym:tests.support.environments:OddEndless-v0", normalise=True)
    parameters = np.zeros(endless.controller.size, np.float32)
    assert Scorer(endless).score("evaluate", parameters, 1).steps == DEFAULT_MAX_STEPS


def test_a_name_with_a_version_is_taken_although_the_environment_shows_that_of_another(monkeypatch):
    inside = gymnasium.make("CartPole-v1")
    monkeypatch.setattr(environments, "make_environment", lambda *_: inside)
    assert describe_task("gym:MyCart-v0", {}).observations == 4


def test_a_controller_of_other_outputs_is_refused():
    with pytest.raises(ControllerError):
        Scorer(TaskSpec(CARTPOLE, "", 100, 0, ControllerShape(4, 3)))


def test_bounded_numbers_anywhere_are_one_vector():
    space = spaces.Dict({"turn": spaces.Box(-1, 1, (2, 2), np.float32), "gas": spaces.Box(0, 3, (1,), np.float64)})
    actions = vector_actions(space, "it")
    assert actions == Continuous.between([0, -1, -1, -1, -1], [3, 1, 1, 1, 1])
    taken = make_converter(space, actions)(np.float32([2, 0.1, 0.2, 0.3, 0.4]))
    assert taken in space
    assert taken["turn"].tolist() == np.float32([[0.1, 0.2], [0.3, 0.4]]).tolist()


@pytest.mark.parametrize(
    "space",
    [
        spaces.MultiDiscrete([4096, 1]),
        spaces.Discrete(4097),
        spaces.MultiBinary(2049),
        spaces.Box(0, 1, (4097,)),
        spaces.Tuple((spaces.Discrete(2), spaces.Box(0, 1, (1,)))),
        ACTIONS["endless"],
        spaces.Box(-np.inf, 1, (1,)),
        spaces.Text(3),
        spaces.Dict({}),
    ],
)
def test_other_actions_are_refused(space):
    with pytest.raises(UsageError):
        vector_actions(space, "it")


def scorer(kind):
    return Scorer(described_spec(f"gym:{STRICT}", environment={"actions": kind}))


@pytest.mark.parametrize("kind", sorted({*ACTIONS} - {"endless"}))
def test_saturated_controllers_and_world_models_stay_within_the_space(kind):
    actions, made = vector_actions(ACTIONS[kind], "it"), scorer(kind)
    convert = make_converter(ACTIONS[kind], actions)
    for value in (-1e6, 0, 1e6):
        assert convert(actions.to_action(np.full(actions.outputs, value, np.float32))) in ACTIONS[kind]
        assert made.score("score", np.full(made.spec.controller.size, value, np.float32), 1).fitness == 20


def test_an_environment_of_single_precision_gets_the_vector_as_it_is():
    action = np.float32([0.05, -0.1])
    with find_task(f"gym:{STRICT}").make_environment(Assignment(scorer("float32").spec)) as environment:
        environment.reset(seed=1)
        assert environment.step(action)[4]["taken"] is action


def test_whole_numbers_are_the_nearest():
    convert = make_converter(ACTIONS["mixed"], vector_actions(ACTIONS["mixed"], "it"))
    taken = convert(np.float32([2.6, 0.1]))
    assert (taken["gear"].tolist(), taken["gear"].dtype, taken["turn"].dtype) == ([3], np.int8, np.float64)


@pytest.mark.parametrize(
    "space",
    [
        spaces.MultiDiscrete([2, 3], start=[5, 0]),
        spaces.Dict({"b": spaces.Discrete(3, start=2), "a": spaces.Tuple((spaces.MultiBinary(2), spaces.Discrete(2)))}),
    ],
)
def test_each_row_of_choices_is_another_element_of_the_space_and_a_row_near_it_is_the_same(space):
    actions = vector_actions(space, "it")
    convert = make_converter(space, actions)
    rows = actions.from_numbers(list(product(*map(range, actions.sizes))))
    flat = [tuple(spaces.flatten(space, convert(row))) for row in rows]
    assert all(convert(row) in space for row in rows)
    assert flat == [tuple(row) for row in rows]
    assert flat == [tuple(spaces.flatten(space, convert(0.6 * row + 0.2))) for row in rows]
    assert len(set(flat)) == len(flat) == prod(actions.sizes)


@pytest.mark.parametrize(
    ("space", "outputs"),
    [
        (spaces.MultiDiscrete([[3, 2], [4, 5]], start=[[1, 0], [0, 9]]), 14),
        (spaces.MultiBinary(12), 24),
        (spaces.MultiBinary((2, 3)), 12),
        (spaces.Discrete(4096, start=3), 4096),
        (spaces.MultiDiscrete([4095, 1]), 4096),
        (spaces.Tuple((spaces.Discrete(100), spaces.MultiBinary(2))), 104),
    ],
)
def test_each_number_is_chosen_by_its_own_outputs(space, outputs):
    actions = vector_actions(space, "it")
    convert = make_converter(space, actions)
    assert actions.outputs == outputs
    logits = np.random.default_rng(1).normal(size=(5, outputs)).astype(np.float32)
    together = actions.to_action(logits)
    for row, action in zip(logits, together, strict=True):
        assert np.array_equal(actions.to_action(row), action)
        element = convert(action)
        assert element in space
        assert np.array_equal(spaces.flatten(space, element), action)
        parts = np.split(row, np.cumsum(actions.sizes)[:-1])
        assert actions.to_numbers(action).tolist() == [int(part.argmax()) for part in parts]
        chosen = np.concatenate([np.arange(len(part)) == part.argmax() for part in parts])
        assert np.array_equal(actions.to_outputs(action), chosen)


def fake(kind, **options):
    return find_task(f"gym:{pixel_fakes.MODULE}:{kind}-v0").with_options(json.dumps(options))


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
        ("Stacked", {}),
        ("Stacked", {"observation": "all"}),
    ],
)
def test_an_environment_with_pictures_keeps_the_contract(kind, options):
    task = fake(kind, **options)
    check_world(task)
    assert json.loads(task.options or "{}") == options
    assert task.world.packages[:2] == ("numpy", "gymnasium")
    assert ("pygame-ce" in task.world.packages) == (options.get("observation") == "render"), "it draws"
    assert task.world.frames_per_second == 10 // options.get("skip", 1)
    assert task.world.horizon == 200 // options.get("skip", 1)


def test_channels_first_the_last_of_a_stack_and_what_is_drawn_are_the_same_picture():
    first, drawn, last, plain, stack = (
        drive(fake(kind, **options), 4)[0].seen
        for kind, options in (
            ("ChannelsFirst", {}),
            ("ChannelsFirst", {"observation": "render"}),
            ("Stacked", {}),
            ("Unseen", {"observation": "render"}),
            ("Stacked", {"observation": "all"}),
        )
    )
    assert np.array_equal(first, plain)
    assert np.array_equal(drawn, plain)
    assert np.array_equal(last[..., 0], plain[..., 0])
    assert not stack[:32].any()
    assert not stack[32:, :32].any()
    assert stack[32:, 32:].any()


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
        ("CartPole-v1", {"environment": {"inner": "no-such:X-v0"}}, "--trust no-such"),
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
    assert one is not fake("Grey", size=96)


@pytest.mark.parametrize("options", [{"crop": "8:48,0:40"}, {"difference": True}])
def test_a_parts_picture_is_that_of_the_preprocessing(options):
    task = fake("InDict", **options)
    (preprocessing,) = task.preprocessings.values()
    seen = gymnasium.make(f"{pixel_fakes.MODULE}:InDict-v0").reset(seed=4)[0]["screen"]
    assert np.array_equal(preprocessing.picture(seen), task.make_recorded(preprocessing.name).reset(seed=4)[0])


def drive(task, seed):
    (name,) = task.preprocessings
    policy = DriverPolicy(task.drivers["held"](np.random.default_rng(1)))
    with task.make_recorded(name) as environment:
        return list(run_episode(environment, policy, EpisodeConfig(seed, 1000)))


def test_the_black_picture_of_an_end_is_never_seen():
    ends = [drive(fake("InDict"), seed)[-1] for seed in range(10)]
    assert all(end.terminal and end.seen.any() for end in ends)


def test_a_limit_is_no_death_whatever_the_environment_says():
    ends = [drive(fake("BothEnds"), seed)[-1] for seed in range(30)]
    assert {(each.terminal, each.step == 25) for each in ends} == {(True, False), (False, True)}
    assert all(each.ended for each in ends)


RUDE = f"{pixel_fakes.MODULE}:Rude-v0"


@pytest.mark.parametrize("close", ["raises", "exits"])
def test_what_a_rude_one_does_as_it_is_made_and_closed_is_undone(close, capfd, caplog):
    folder, handlers = Path.cwd(), [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    world = GymTask(RUDE).with_options(json.dumps({"environment": {"close": close}})).world
    assert (world.actions.outputs, world.action_names, world.frames_per_second) == (3, (), 30)
    assert Path.cwd() == folder
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == handlers
    out, err = capfd.readouterr()
    assert (out, err.count("made")) == ("", 4)
    assert "Rude" in caplog.text
    assert "\n" not in caplog.messages[-1]


def test_drives_of_a_rude_one_are_collected_where_the_verb_was_told_and_its_answer_is_whole(tmp_path):
    born = tmp_path / "born"
    words = ("collect", "--data", "data", "--task", f"gym:{RUDE}", "--environment", f"child={born}")
    done = subprocess.run(
        command(*words, "--episodes", 2, "--steps", 4, "--jobs", 2, "--json"),
        cwd=tmp_path, env=environment(tmp_path), capture_output=True, text=True, timeout=DEADLINE, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["new_episodes"] == 2
    assert sorted(each.name for each in (tmp_path / "data" / "episodes").iterdir()) == ["000000.npz", "000001.npz"]
    children = [int(each) for each in born.read_text().split()]
    assert children
    until(lambda: not any(map(runs, children)), "a process of the environment outlives the verb")
