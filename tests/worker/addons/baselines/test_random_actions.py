"""Uniform random actions are judged in any environment by the path that judges a controller of that task.
Tests agents.py, worker/tasks/model_free_policies.py and worker/addons/evaluation/named_agents.py."""

import json
import re
from pathlib import Path

import av
import numpy as np
import pytest

from dreamfleet.common.addons.evaluation_report import read_evaluation_report
from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE, Continuous, Discrete
from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.cli import command_line
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.addons.baselines.agents import RandomPolicy
from dreamfleet.worker.addons.evaluation import evaluation
from dreamfleet.worker.addons.evaluation.named_agents import DISCRETE, RANDOM, find_driver
from dreamfleet.worker.scoring.episode import EpisodeConfig

CARTPOLE, LANDER = "gym:CartPole-v1", "gym:LunarLander-v3"


def call(*words):
    return command_line.main(list(map(str, words)))


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def judge(out, *words, name="random"):
    assert call("evaluate", "--controller", name, "--episodes", 3, "--out", out, *words) == 0
    return read_evaluation_report(Path(out))


def test_random_actions_are_judged_in_the_named_environment_and_the_same_again(capsys):
    found = judge("first.json", "--task", CARTPOLE, "--jobs", 2)
    printed = capsys.readouterr()
    assert CARTPOLE in printed.err.splitlines()[0]
    assert (found.task, found.world, found.threshold) == (CARTPOLE, CARTPOLE, 475)
    assert len({each.steps for each in found.drives}) > 1  # another seed, other actions
    assert judge("again.json", "--task", CARTPOLE, "--jobs", 1).drives == found.drives


@pytest.mark.parametrize(("name", "different"), [(RANDOM, 200), (DISCRETE, 5)])
def test_in_the_default_world_how_a_random_driver_drives_is_reported_too(name, different, monkeypatch):
    monkeypatch.setattr(evaluation, "EpisodeConfig", lambda seed, _horizon: EpisodeConfig(seed, 6))
    monkeypatch.setattr(evaluation, "evaluate_in_processes", evaluation.evaluate)  # a child would not know it
    found, again = (judge("found.json", "--jobs", 1, name=name) for _ in range(2))
    assert found.drives == again.drives
    assert (found.world, found.bundle, {each.steps for each in found.drives}) == ("car-racing", "", {6})
    assert all(each.speed is not None and each.braking is not None for each in found.drives)
    policies = find_driver(name, Path()).make_policies()
    assert len({tuple(policies(seed).act(None)) for seed in range(3)}) > 1
    policy = policies(0)
    assert len({tuple(policy.act(None)) for _ in range(200)}) == different


def test_without_a_task_the_first_line_names_the_world(capsys):
    assert call("record", "--controller", "random", "--steps", 3) == 0
    assert re.search("car-racing.*--task", capsys.readouterr().err.splitlines()[0])


@pytest.mark.slow
def test_a_report_of_random_actions_is_verified_under_its_environments_arguments():
    found = judge("report.json", "--task", LANDER, "--environment", "continuous=true")
    assert json.loads(found.options) == {"environment": {"continuous": True}}
    assert found.controller != judge("numbered.json", "--task", LANDER).controller
    assert call("verify", "report", "report.json") == 0


def test_random_actions_are_recorded_in_the_named_environment(capsys):
    assert call("record", "--task", LANDER, "--controller", "random", "--steps", 5, "--json") == 0
    assert json.loads(capsys.readouterr().out)["seed"] == 10_000
    with av.open("drive.mp4") as container:
        assert len(list(container.decode(container.streams.video[0]))) == 5


def test_actions_are_even_within_any_actions():
    for actions, low, high in (
        (Continuous.between([-2, 0], [3, 1]), (-2, 0), (3, 1)),
        (STEERING_GAS_BRAKE, (-1, 0, 0), (1, 1, 1)),
        (Discrete(3, first=5), 5, 7),
    ):
        policy = RandomPolicy(np.random.default_rng(1), actions)
        drawn = np.array([policy.act(None) for _ in range(4000)])
        assert drawn.min(axis=0) == pytest.approx(low, abs=0.02)
        assert drawn.max(axis=0) == pytest.approx(high, abs=0.02)
        assert drawn.mean(axis=0) == pytest.approx((np.array(low) + high) / 2, abs=0.06)


def test_actions_are_no_copy_of_the_environments_own_chance(tmp_path):
    agent = find_driver("random", tmp_path, task=LANDER, options={"environment": {"continuous": True}})
    drawn = agent.make_policies()(7).act(None)
    copied = np.random.default_rng(7).uniform(-1, 1, 2).astype(np.float32)
    assert not np.isclose(drawn, copied).any()


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--task", "dream"), "dream"),
        (("--environment", "continuous=true"), "car-racing"),
        (("--task", "CartPole-v1"), "CartPole-v1"),
        (("--task", CARTPOLE, "--bundle", "tiny"), "--bundle"),
        (("--task", CARTPOLE, "--environment", "gravity"), "gravity"),
        (("--task", CARTPOLE, "--environment", "colour=1"), "colour"),
    ],
)
def test_a_world_that_random_actions_cannot_be_judged_in_is_one_line(words, named, capsys):
    assert call("evaluate", "--controller", "random", "--episodes", 1, *words) == UsageError.exit_code
    assert named in capsys.readouterr().err


def test_a_controller_has_a_world_of_its_own(tmp_path, capsys):
    shape, path = ControllerShape(4, 2), tmp_path / "controller.npz"
    Controller(shape, np.zeros(shape.size, np.float32), CARTPOLE, "").save(path)
    for verb, name in (("evaluate", path), ("record", path), ("evaluate", DISCRETE)):
        assert call(verb, "--controller", name, "--task", CARTPOLE) == UsageError.exit_code
        assert "--controller" in capsys.readouterr().err
