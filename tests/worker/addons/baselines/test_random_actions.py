"""Uniform random actions are judged in any environment by the path that judges a controller of that task.
Tests agents.py and worker/addons/evaluation/named_agents.py."""

import json
import re

import av
import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import FIVE_CHOICES, STEERING_GAS_BRAKE, Continuous, Discrete
from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.cli import command_line
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.addons.baselines.agents import RandomPolicy
from dreamfleet.worker.addons.evaluation.evaluation_report import read_evaluation_report
from dreamfleet.worker.addons.evaluation.named_agents import find_driver

CARTPOLE, LANDER = "gym:CartPole-v1", "gym:LunarLander-v3"


def call(*words):
    return command_line.main(list(map(str, words)))


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def judge(task, out, *words):
    assert call("evaluate", "--task", task, "--controller", "random", "--episodes", 3, "--out", out, *words) == 0
    return read_evaluation_report(out)


def test_random_actions_are_judged_in_the_named_environment_and_the_same_again(tmp_path, capsys):
    found = judge(CARTPOLE, tmp_path / "first.json", "--jobs", 2)
    printed = capsys.readouterr()
    assert CARTPOLE in printed.err.splitlines()[0]
    assert (found.task, found.world, found.threshold) == (CARTPOLE, CARTPOLE, 475)
    assert len({each.steps for each in found.drives}) > 1  # another seed, other actions
    assert judge(CARTPOLE, tmp_path / "again.json", "--jobs", 1).drives == found.drives


def test_without_a_task_the_first_line_names_the_world(tmp_path, capsys):
    words = ("--controller", "random", "--steps", 3, "--out", tmp_path / "drive.mp4")
    assert call("record", *words) == 0
    assert re.search("car-racing.*--task", capsys.readouterr().err.splitlines()[0])


@pytest.mark.slow
def test_a_report_of_random_actions_is_verified_under_its_environments_arguments(tmp_path, capsys):
    found = judge(LANDER, tmp_path / "report.json", "--environment", "continuous=true")
    assert json.loads(found.options) == {"environment": {"continuous": True}}
    assert found.controller != judge(LANDER, tmp_path / "numbered.json").controller
    assert call("verify", "report", tmp_path / "report.json") == 0
    assert "3 bit-identical scores" in capsys.readouterr().out


def test_random_actions_are_recorded_in_the_named_environment(tmp_path, capsys):
    out = tmp_path / "drive.mp4"
    assert call("record", "--task", LANDER, "--controller", "random", "--steps", 5, "--out", out, "--json") == 0
    assert json.loads(capsys.readouterr().out)["seed"] == 10_000
    with av.open(str(out)) as container:
        assert len(list(container.decode(container.streams.video[0]))) == 5


def test_actions_are_even_within_any_actions_and_the_seeds():
    for actions, low, high in (
        (Continuous.between([-2, 0], [3, 1]), (-2, 0), (3, 1)),
        (STEERING_GAS_BRAKE, (-1, 0, 0), (1, 1, 1)),
        (Discrete(3, first=5), 5, 7),
    ):
        drawn = np.array([RandomPolicy(np.random.default_rng(1), actions).act(None) for _ in range(2)])
        assert (drawn[0] == drawn[1]).all()
        policy = RandomPolicy(np.random.default_rng(1), actions)
        drawn = np.array([policy.act(None) for _ in range(4000)])
        assert drawn.min(axis=0) == pytest.approx(low, abs=0.02)
        assert drawn.max(axis=0) == pytest.approx(high, abs=0.02)
        assert drawn.mean(axis=0) == pytest.approx((np.array(low) + high) / 2, abs=0.06)
    policy = RandomPolicy(np.random.default_rng(1), FIVE_CHOICES)
    assert len({tuple(policy.act(None)) for _ in range(200)}) == 5


def test_actions_are_no_copy_of_the_environments_own_chance(tmp_path):
    agent = find_driver("random", tmp_path, task=LANDER, options={"environment": {"continuous": True}})
    seed = 7
    drawn = agent.make_policies()(seed).act(None)
    copied = np.random.default_rng(seed).uniform(-1, 1, 2).astype(np.float32)
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
    for verb in ("evaluate", "record"):
        assert call(verb, "--controller", path, "--task", CARTPOLE) == UsageError.exit_code
        assert "--controller" in capsys.readouterr().err
    assert call("evaluate", "--controller", "random-discrete", "--task", CARTPOLE) == UsageError.exit_code
    assert "--controller" in capsys.readouterr().err
