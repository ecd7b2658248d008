"""Environments of which a process can hold one instance at a time."""

import json

import numpy as np
import pytest

from dreamfleet import Controller, ControllerShape, Scorer, TaskSpec
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.worker.addons.evaluation.agents import make_agent
from dreamfleet.worker.addons.evaluation.evaluation import evaluate
from dreamfleet.worker.addons.recording.recording import record
from dreamfleet.worker.addons.task_check import dry_run
from dreamfleet.worker.scoring.rollout import DataWorld
from dreamfleet.worker.training.data.collect import drive_episode
from dreamfleet.worker.training.data.collect_config import CollectConfig
from dreamfleet.worker.worlds.gym.task import GymTask
from tests.support.bundles import write_world_bundle
from tests.support.pixel_fakes import MODULE
from tests.support.watching import Watching

SHAPE = ControllerShape(2, 3)


@pytest.mark.parametrize("kind", ["Single", "Shared"])
def test_it_is_checked_scored_watched_judged_filmed_collected_and_scored_by_a_world_model(kind, tmp_path):
    name = f"gym:{MODULE}:{kind}-v0"
    *_, found = dry_run(name, {"normalise": True}, lambda _step: None, thorough=True)
    assert found.episode == found.repeated != ""
    assert "normal" in json.loads(found.description.options)
    assert found.warnings == ()
    scorer = Scorer(TaskSpec(name, "", 1000, 0, SHAPE))
    assert (bool(scorer.host_class), scorer.side_by_side) == (True, 1)
    parameters = np.linspace(-1, 1, SHAPE.size, dtype=np.float32)
    plain = scorer.score("score", parameters, 7)
    scorer.observer = Watching()
    assert scorer.score("score", parameters, 7) == plain
    assert len(scorer.observer) == plain.steps > 9
    scorer.close()
    agent = make_agent(Controller(SHAPE, np.zeros(SHAPE.size, np.float32), name, ""))
    (episode,) = evaluate(agent, (7,), jobs=1)
    assert record(agent, 7, episode.steps, tmp_path / "drive.mp4")[0] == episode.score
    options = '{"observation": "render"}'
    task = GymTask(f"{MODULE}:{kind}-v0").with_options(options)
    arrays = drive_episode(CollectConfig(episodes=1, steps=10, anywhere=0), 0, world=DataWorld(task.name, options))
    assert arrays["picture"].shape == (10, 64, 64, 3)
    facts = task.world.facts(RewardFacts("survival"), EndRule(), task.options)
    bundle = write_world_bundle(tmp_path / "world.zip", facts, task.name)
    scorer = Scorer(TaskSpec(task.name, bundle.sha256, horizon=10, patience=0), bundle)
    assert scorer.score("score", np.zeros(bundle.controller_shape.size, np.float32), 7).steps == 10
    scorer.close()
