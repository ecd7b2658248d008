"""Watching episodes while they are scored: what the observer gets, and that no score changes by a bit.
Tests worker/tasks/watching.py."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control.cartpole import CartPoleEnv

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worldmodel.inference import DreamStep

HORIZON = 40


class Eyes:
    """Observes every so many steps."""

    def __init__(self, every=3):
        self.seen, self._every, self._asked = [], every, 0

    def is_due(self):
        self._asked += 1
        return self._asked % self._every == 0

    def observe(self, episode, look):
        self.seen.append((episode, look()))


def parameters(size, seed=0):
    return np.random.default_rng(seed).normal(0, 0.3, size).astype(np.float32)


def watched_and_not(scorer, jobs):
    """The scores of a group: unwatched, watched and unwatched; and the observed steps."""
    before = scorer.score_all(jobs, lambda _made: None)
    scorer.observer = eyes = Eyes()
    during = scorer.score_all(jobs, lambda _made: None)
    scorer.observer = None
    assert before == during == scorer.score_all(jobs, lambda _made: None)
    return before, eyes.seen


@pytest.mark.parametrize("kind", ["score", "evaluate", "collect"])
def test_a_step_with_a_world_model_shows_picture_latent_and_state(random_bundle, kind):
    scorer = Scorer(TaskSpec("car-racing", random_bundle.sha256, HORIZON, 0), random_bundle)
    vector = parameters(random_bundle.controller_shape.size)
    if kind == "collect":
        (plain, kept), eyes = scorer.collect(vector, 2**20), Eyes()
        scorer.observer = eyes
        again, shown = scorer.collect(vector, 2**20)
        assert (again, shown.to_bytes()) == (plain, kept.to_bytes())
        seen = eyes.seen
    else:
        scorer.world = replace(scorer.world, horizon=HORIZON)  # evaluations use the world's
        _, seen = watched_and_not(scorer, [(kind, vector, 2**20)])
    assert [step.step for _, step in seen] == list(range(2, HORIZON, 3))
    assert {step.picture.shape for _, step in seen} == {(64, 64, 3)}
    dream = DreamStep(random_bundle)
    for _, step in seen:  # latent and state are those from before the action
        acted = dream.step(
            step.latent[None], vector[None], step.state[None], np.zeros((1, 32), np.float32),
            np.zeros((1, 32), np.float32), 1.0,
        )  # fmt: skip
        assert np.allclose(acted.action[0], step.action, atol=1e-5)
    scorer.close()


def test_a_batch_of_dreams_shows_the_first_that_has_not_ended(random_bundle):
    scorer = Scorer(TaskSpec("dream", random_bundle.sha256, HORIZON, 0, temperature=1.0), random_bundle)
    jobs = [("score", parameters(random_bundle.controller_shape.size, row), 2**20 + row) for row in range(20)]
    scores, seen = watched_and_not(scorer, jobs)
    assert seen
    for episode, step in seen:
        assert all(score.steps <= step.step for score in scores[:episode]), "an earlier one still goes on"
        assert step.picture is None
        assert (step.latent.shape, step.action.shape) == ((32,), (3,))
    scorer.close()


@pytest.mark.parametrize("name", ["gym:CartPole-v1", "gym:LunarLander-v3", "gym:Acrobot-v1"])
def test_gymnasiums_own_worlds_are_drawn_while_watched(name):
    spec = TaskSpec(name, "", 200, 0, controller=shape_of(find_task(name).describe({})))
    scorer = Scorer(spec)
    jobs = [("score", parameters(spec.controller.size, row), 2**20 + row) for row in range(3)]
    _, seen = watched_and_not(scorer, jobs)
    assert {episode for episode, _ in seen} == {0, 1, 2}
    pictures = {step.picture.tobytes() for _, step in seen}
    assert len(pictures) > 3
    scorer.close()


def shape_of(world):
    return ControllerShape(world.observations, world.outputs)


def test_drawing_does_not_change_the_steps():
    task = find_task("gym:LunarLander-v3")
    shown = task.make_watched_environment(
        Assignment(TaskSpec(task.name, "", 200, 0, controller=shape_of(task.describe({}))))
    )
    shown.reset(seed=1)
    for _ in range(30):
        shown.step(2)  # the main engine, whose sparks are bodies that each further step computes
    assert shown.unwrapped.particles == []
    assert shown.render().shape == (400, 600, 3)
    shown.step(2)
    assert shown.unwrapped.particles == []
    shown.close()


class Sketchy(CartPoleEnv):
    """An environment of another package, whose `render` might change scores."""


def test_other_packages_worlds_are_shown_without_a_picture(monkeypatch):
    gymnasium.register("Sketchy-v0", Sketchy, max_episode_steps=50)
    task = find_task("gym:Sketchy-v0")
    spec = TaskSpec("gym:Sketchy-v0", "", 50, 0, controller=shape_of(task.describe({})))
    assert task.make_watched_environment(Assignment(spec)) is None
    _, seen = watched_and_not(Scorer(spec), [("score", parameters(spec.controller.size), 2**20)])
    assert {step.picture for _, step in seen} == {None}

    own = find_task("gym:CartPole-v1")
    spec = TaskSpec(own.name, "", 50, 0, controller=shape_of(own.describe({})))
    monkeypatch.setattr(CartPoleEnv, "render", lambda self: 1 / 0)
    _, seen = watched_and_not(Scorer(spec), [("score", parameters(spec.controller.size), 2**20)])
    assert {step.picture for _, step in seen} == {None}


def test_the_environment_of_a_watched_drive_is_closed_with_the_scorer():
    task = find_task("gym:CartPole-v1")
    scorer = Scorer(TaskSpec(task.name, "", 50, 0, controller=shape_of(task.describe({}))))
    closed = []
    scorer._watched_environment.close = lambda: closed.append(True)
    scorer.close()
    assert closed == [True]
