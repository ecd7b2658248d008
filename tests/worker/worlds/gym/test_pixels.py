"""Any gymnasium environment with pictures as a world of data sets and world models."""

import json
import signal
import subprocess
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.processes import command
from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.tasks.model_free_policies import DriverPolicy
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worlds.gym.task import GymTask
from tests.support import pixel_fakes
from tests.support.pixel_world import DODGE
from tests.support.processes import DEADLINE, environment, runs, until
from tests.support.world_contract import check_world


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


def rude(**arguments):
    return GymTask(RUDE).with_options(json.dumps({"environment": arguments}))


@pytest.mark.parametrize("close", ["raises", "exits"])
def test_what_a_rude_one_does_as_it_is_made_and_closed_is_undone(close, capfd, caplog):
    folder, handlers = Path.cwd(), [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    world = rude(close=close).world
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
