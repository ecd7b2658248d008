"""Watching episodes while they are scored: what the observer gets, and that no score changes by a bit.
What a host computes on
fixed inputs is its class. Tests host_class_probe.py, common/host/fingerprint.py and worker/tasks/watching.py."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control.cartpole import CartPoleEnv

from dreamfleet import ControllerShape, Scorer, TaskSpec
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.protocol.host_classes import NON_DETERMINISTIC, class_from_fingerprint
from dreamfleet.worker.scoring.host_class_probe import HostClassProbe, fixed_parameters
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.model_free_policies import FlatPolicy
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worldmodel.inference import DreamStep
from dreamfleet.worker.worlds.car_racing import reference
from tests.support import tasks
from tests.support.environments import ODD
from tests.support.specs import described_spec
from tests.support.watching import Watching

HORIZON = 40


def parameters(size, seed=0):
    return np.random.default_rng(seed).normal(0, 0.3, size).astype(np.float32)


def watched_and_not(scorer, jobs):
    """The scores of a group: unwatched, watched and unwatched; and the observed steps."""
    before = scorer.score_all(jobs, lambda _made: None)
    scorer.observer = watching = Watching(every=3)
    during = scorer.score_all(jobs, lambda _made: None)
    scorer.observer = None
    assert before == during == scorer.score_all(jobs, lambda _made: None)
    return before, watching


@pytest.mark.parametrize("kind", ["score", "evaluate", "collect"])
def test_a_step_with_a_world_model_shows_picture_latent_and_state(random_bundle, kind):
    scorer = Scorer(TaskSpec("car-racing", random_bundle.sha256, HORIZON, 0), random_bundle)
    vector = parameters(random_bundle.controller_shape.size)
    if kind == "collect":
        plain, kept = scorer.collect(vector, 2**20)
        scorer.observer = seen = Watching(every=3)
        again, shown = scorer.collect(vector, 2**20)
        assert (again, shown.to_bytes()) == (plain, kept.to_bytes())
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


def test_a_batch_of_dreams_shows_the_first_that_has_not_ended(random_bundle):
    scorer = Scorer(TaskSpec("dream", random_bundle.sha256, HORIZON, 0, temperature=1.0), random_bundle)
    jobs = [("score", parameters(random_bundle.controller_shape.size, row), 2**20 + row) for row in range(20)]
    scores, seen = watched_and_not(scorer, jobs)
    assert seen
    for episode, step in seen:
        assert all(score.steps <= step.step for score in scores[:episode]), "an earlier one still goes on"
        assert step.picture is None
        assert (step.latent.shape, step.action.shape) == ((32,), (3,))


@pytest.mark.parametrize("name", ["gym:CartPole-v1", "gym:LunarLander-v3", "gym:Acrobot-v1"])
def test_gymnasiums_own_worlds_are_drawn_while_watched_by_an_environment_that_is_closed_with_the_scorer(name):
    scorer, closed = Scorer(described_spec(name, 200)), []
    jobs = [("score", parameters(scorer.spec.controller.size, row), 2**20 + row) for row in range(3)]
    _, seen = watched_and_not(scorer, jobs)
    assert {episode for episode, _ in seen} == {0, 1, 2}
    assert len({step.picture.tobytes() for _, step in seen}) > 3
    scorer._watched_environment.close = lambda: closed.append(True)
    scorer.close()
    assert closed == [True]


def test_drawing_does_not_change_the_steps():
    spec = described_spec("gym:LunarLander-v3", 200)
    shown = find_task(spec.task).make_watched_environment(Assignment(spec))
    shown.reset(seed=1)
    for _ in range(30):
        shown.step(2)  # the main engine, whose sparks are bodies that each further step computes
    assert shown.unwrapped.particles == []
    assert shown.render().shape == (400, 600, 3)
    shown.step(2)
    assert shown.unwrapped.particles == []
    shown.close()


def test_other_packages_worlds_and_what_cannot_be_drawn_are_shown_without_a_picture(monkeypatch):
    class Sketchy(CartPoleEnv):
        """An environment of another package, whose `render` might change scores."""

    gymnasium.register("Sketchy-v0", Sketchy, max_episode_steps=50)
    assert (
        find_task("gym:Sketchy-v0").make_watched_environment(Assignment(described_spec("gym:Sketchy-v0", 50))) is None
    )
    for name in ("gym:Sketchy-v0", "gym:CartPole-v1"):
        spec = described_spec(name, 50)
        _, seen = watched_and_not(Scorer(spec), [("score", parameters(spec.controller.size), 2**20)])
        assert {step.picture for _, step in seen} == {None}
        monkeypatch.setattr(CartPoleEnv, "render", lambda self: 1 / 0)


CART_POLE = TaskSpec("gym:CartPole-v1", "", 500, 0, ControllerShape(4, 2))


def scorer_of(task, bundle):
    return Scorer(TaskSpec(task, bundle.sha256, 100, 0), bundle)


@pytest.mark.parametrize("task", ["car-racing", "dream"])
def test_the_host_class_does_not_depend_on_what_ran_before(random_bundle, task):
    job = "score", fixed_parameters(random_bundle.controller_shape.size), 7
    scorer, again = scorer_of(task, random_bundle), scorer_of(task, random_bundle)
    found, score = scorer.host_class, again.score(*job)
    assert len(found) == 16
    assert again.host_class == found
    assert scorer.score(*job) == again.score(*job) == score


def test_another_bit_of_the_world_is_another_class(random_bundle, monkeypatch):
    here = scorer_of(tasks.ROUNDED, random_bundle).host_class
    monkeypatch.setenv(tasks.ROUNDING, "1")
    assert scorer_of(tasks.ROUNDED, random_bundle).host_class != here


def test_who_drives_makes_no_class_but_a_simulator_that_fuses_products_does(random_bundle, monkeypatch):
    here = scorer_of("car-racing", random_bundle).host_class
    monkeypatch.setattr("dreamfleet.worker.worlds.car_racing.native_check.native_is_exact", lambda: False)
    assert scorer_of("car-racing", random_bundle).host_class == here
    monkeypatch.setattr(reference, "box2d_fuses_products", lambda: True)
    assert scorer_of("car-racing", random_bundle).host_class != here


def test_another_bit_of_a_policys_outputs_is_another_class_and_another_package_version_is_not(monkeypatch):
    here = Scorer(CART_POLE).host_class
    monkeypatch.setattr("dreamfleet.worker.scoring.scorer.fingerprint", lambda _: "riscv64 other")
    assert Scorer(CART_POLE).host_class == here
    outputs = FlatPolicy.outputs
    monkeypatch.setattr(FlatPolicy, "outputs", lambda self, seen: np.nextafter(outputs(self, seen), np.float32(9)))
    assert Scorer(CART_POLE).host_class != here


@pytest.mark.parametrize("task", [tasks.RAISING, tasks.CRASHING])
def test_without_a_probe_episode_the_fingerprint_gives_the_class(random_bundle, task):
    scorer = scorer_of(task, random_bundle)
    assert scorer.host_class == class_from_fingerprint(fingerprint(scorer.world.packages))


def test_all_observed_values_count_and_memory_addresses_do_not():
    def host_class(value):
        found = HostClassProbe()
        found.add_value(value)
        return found.host_class

    assert host_class({"a": 1, "b": (1.5, None)}) == host_class({"b": (1.5, None), "a": 1})
    assert host_class(np.float32(0.0)) != host_class(np.float32(-0.0))
    assert host_class(0.1 + 0.2) != host_class(0.3)
    assert host_class(np.zeros(2)) != host_class(np.zeros((2, 1)))
    assert host_class([object()]) == host_class([object()])


def test_the_parameters_are_the_same_bits_everywhere():
    assert fixed_parameters(3).tobytes() == fixed_parameters(867)[:3].tobytes()
    assert fixed_parameters(3).tobytes().hex() == "cebb713d192207beda4c353e"


@pytest.mark.parametrize("fault", ["noise", "random", "carry"])
def test_an_environment_that_is_not_deterministic_has_a_class_of_its_own(fault):
    options = f'{{"environment": {{"fault": "{fault}"}}}}'
    assert Scorer(TaskSpec(ODD, "", 20, 0, ControllerShape(2, 2), options=options)).host_class == NON_DETERMINISTIC
