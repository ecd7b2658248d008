"""An evaluator reports how an episode was driven, and the statistics change nothing. Tests agents.py."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.runs.episode_results import EpisodeResult
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.worker.addons.evaluation import evaluation as judging
from dreamfleet.worker.addons.evaluation.agents import make_agent
from dreamfleet.worker.addons.evaluation.evaluation import AgentEvaluator, DriveStatistics
from dreamfleet.worker.scoring.episode import EpisodeConfig, Transition, score
from dreamfleet.worker.tasks.api import Score, World
from dreamfleet.worker.tasks.registry import find_task

STEPS = 12
SEED = 20_003


@pytest.fixture(scope="module")
def tiny():
    return find_bundle("tiny")


@pytest.mark.parametrize("task", ["car-racing", "dream"])
def test_it_reports_speed_and_brake_of_a_drive_that_is_the_same_unwatched(tiny, monkeypatch, tmp_path, task):
    monkeypatch.setattr(judging, "EpisodeConfig", lambda seed, _horizon: EpisodeConfig(seed, STEPS))
    controller = find_controller("tiny", tmp_path)[0]
    parameters = controller.parameters.copy()
    parameters[2 * 288 : 3 * 288], parameters[-1] = 0.0, 5.0  # the brake's weights and bias: it is always on
    agent = make_agent(replace(controller, parameters=parameters, task=task), tiny)
    judge, unwatched = AgentEvaluator(agent), agent.make_evaluation_environment()
    drive = judge.drive(SEED)
    alone = score(unwatched, agent.make_policies()(SEED), parameters, EpisodeConfig(SEED, STEPS))
    judge.close()
    unwatched.close()
    assert (drive.seed, drive.score, drive.steps) == (SEED, alone.fitness, STEPS)
    assert drive.finished is False
    assert drive.braking == 1.0
    assert 0 <= drive.speed < 20


def test_a_world_without_a_true_state_has_no_statistics():
    watch = DriveStatistics(World(STEERING_GAS_BRAKE, action_names=("steer", "gas", "brake")), None)
    watch.on_transition(moment({"lap_finished": True}))
    assert watch.drive(3, Score(5.0, 1)) == EpisodeResult(3, 5.0, 1)


@pytest.mark.parametrize(
    ("last", "finished"), [({"lap_finished": True}, True), ({"lap_finished": False}, False), ({}, False)]
)
def test_a_lap_is_finished_if_the_environment_says_so_at_the_end(last, finished):
    watch = DriveStatistics(find_task("car-racing").world, lambda: {"speed": 30.0})
    for info in ({}, last):
        watch.on_transition(moment(info))
    drive = watch.drive(1, Score(900.0, 2))
    assert (drive.finished, drive.speed, drive.braking) == (finished, 30.0, 0.0)


def test_gymnasium_reports_a_finished_lap():
    """gymnasium's flag in `info`: true when all tiles were visited, false when the car left the field."""
    environment = gymnasium.make("CarRacing-v3")
    environment.reset(seed=1)
    inner = environment.unwrapped
    inner.new_lap = True
    *_, terminated, truncated, info = environment.step(np.zeros(3, np.float32))
    environment.close()
    assert (terminated, truncated, info) == (True, False, {"lap_finished": True})


def moment(info):
    return Transition(None, np.zeros(3), 1.0, 1, bool(info), False, info)
