"""Tests api.py, batches.py, measures.py, model_free_policies.py, registry.py, common/protocol/measures.py,
common/protocol/tasks.py and worker/scoring/scorer.py."""

import os
import re
import subprocess
import sys
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from dreamfleet import Bundle, ControllerShape, Discrete, Scorer, TaskSpec, find_bundle, find_controller
from dreamfleet.common.artifacts.car_racing_variants import FACTS, Variant
from dreamfleet.common.errors import BundleError, ControllerError, UsageError
from dreamfleet.common.protocol.tasks import is_self_describing
from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.scoring.episode import run_episode, score
from dreamfleet.worker.tasks.api import Assignment, Continuous, Task, World
from dreamfleet.worker.tasks.measures import Measurer
from dreamfleet.worker.tasks.registry import find_task
from tests.support.processes import DEADLINE, ROOT
from tests.support.variants import VARIANTS


@pytest.mark.parametrize("name", ["os:abort", "sys:exit", "tests.support.tasks:steps_made"])
def test_what_is_no_class_is_never_called_as_a_task(name):
    with pytest.raises(UsageError):
        find_task(name)


@pytest.mark.parametrize(
    ("name", "named"),
    [
        ("moon", "car-racing"),
        ("CarRacing-v3", "car-racing"),
        ("carracing", "car-racing"),
        ("car-racin", "car-racing"),
        ("LunarLander-v3", "gym.LunarLander-v3"),
        ("tests.support.tasks:Moon", "Moon"),
        ("no.such:Task", "no"),
    ],
)
def test_an_unknown_task_is_an_error_that_says_which_there_are(name, named):
    with pytest.raises(UsageError, match=named):
        find_task(name)


@pytest.mark.parametrize("name", ["Field-v0", "FieldOfThisTest"])
def test_a_name_of_an_environment_without_its_family_is_offered_with_it(name, monkeypatch):
    monkeypatch.setitem(gymnasium.registry, "FieldOfThisTest", None)
    with pytest.raises(UsageError, match=f"gym:tests.support.tasks:{name}") as refused:
        is_self_describing(f"tests.support.tasks:{name}")
    assert "--bundle" not in str(refused.value), "its module is here"
    with pytest.raises(UsageError, match=f"gym:tests.support.tasks:{name}"):
        find_task(f"tests.support.tasks:{name}")


@pytest.mark.parametrize("task", ["car-racing", "dream"])
@pytest.mark.parametrize(
    "change", [{"task": "moon"}, {"preprocessing": "none"}, {"preprocessing": "raw-96"}, {"picture": (96, 96, 3)}]
)
def test_a_bundle_of_another_task_or_of_pictures_that_it_does_not_give_is_refused(random_bundle, task, change):
    manifest, found = replace(random_bundle.manifest, world=FACTS, **change), find_task(task)
    bundle = Bundle(random_bundle.path, random_bundle.sha256, manifest)
    asked = task == "dream" and "task" in change  # the dream asks the bundle's own world
    named = "moon" if asked else f"'{manifest.task}' .*'{manifest.preprocessing}'"
    for make in (found.make_environment, found.make_evaluation_environment, found.make_policy):
        with pytest.raises(UsageError if asked else BundleError, match=named):
            make(Assignment.of(task, bundle))


def test_a_job_is_scored_with_the_controller_shape_of_its_run(random_bundle):
    shape = random_bundle.shape_of("z", 4)
    scorer = Scorer(TaskSpec("car-racing", random_bundle.sha256, 5, 0, shape), random_bundle)
    assert scorer.score("score", np.zeros(shape.size, np.float32), 3).steps == 5
    with pytest.raises(ControllerError, match="867 parameters"):
        scorer.score("score", np.zeros(867, np.float32), 3)


def varied(bundle, task="car-racing", horizon=5, **named):
    variant = Variant(**named)
    shape = bundle.shape_of("zh", 0, variant)
    spec = TaskSpec(task, bundle.sha256, horizon, 0, shape, options=variant.options, version=variant.version)
    return spec, np.random.default_rng(1).normal(0, 0.1, shape.size).astype(np.float32)


def judged(spec, bundle, vector, episode_config):
    task, assignment = find_task(spec.task), Assignment(spec, bundle)
    judge = task.make_evaluation_environment(assignment)
    return score(judge, task.make_policy(assignment), vector, episode_config)


@pytest.mark.parametrize("name", VARIANTS)
def test_a_job_is_scored_with_the_variant_of_its_run(random_bundle, name):
    spec, vector = varied(random_bundle, **vars(VARIANTS[name]))
    scorer = Scorer(spec, random_bundle)
    score = scorer.score("score", vector, 3)
    assert scorer.score("score", vector, 3) == score
    assert judged(spec, random_bundle, vector, scorer.episode_config("score", 3)) == score


def test_only_candidates_pay_for_time_and_for_steps_off_the_road(random_bundle):
    costs = {"offroad_cost": 2.0, "time_cost": 0.5}
    (plain, vector), (dear, _) = (varied(random_bundle, horizon=150, **each) for each in ({}, costs))
    vector = np.zeros_like(vector)
    vector[-3:] = 1, 2, -1  # gas, and always to one side
    dream = varied(random_bundle, "dream", horizon=150, **costs)[0]
    scorers = [Scorer(each, random_bundle) for each in (plain, dear, dream)]
    free, paid = (each.score("score", vector, 3) for each in scorers[:2])
    assert free.steps == paid.steps
    assert 2 <= free.fitness - paid.fitness - 0.5 * 150 <= 200
    for kind in ("evaluate", "collect"):
        assert scorers[1].episode_config(kind, 3) == scorers[0].episode_config(kind, 3)
    assert judged(dear, random_bundle, vector, scorers[1].episode_config("score", 3)) == paid
    assert scorers[2].score("score", vector, 3, spec=dream.with_overrides(driven=True)) == paid


def test_a_lap_that_is_over_costs_no_more_time(random_bundle):
    episode_config = Scorer(varied(random_bundle, time_cost=0.5)[0], random_bundle).episode_config("score", 3)
    assert (episode_config.time_cost, episode_config.finish) == (0.5, "lap_finished")
    environment = find_task("car-racing").make_environment(Assignment.of("car-racing", random_bundle))

    environment.unwrapped.lap_complete_percent = -1.0  # the first tile ends the lap

    class Still:
        """Waits for the end."""

        def act(self, _observation):
            return np.zeros(3, np.float32)

    *_, last = run_episode(environment, Still(), episode_config)
    assert last.ended
    assert last.info["lap_finished"]


def test_a_variant_is_another_version_of_the_task_and_is_dreamt_too(random_bundle):
    spec, vector = varied(random_bundle, "dream", 20, **vars(VARIANTS["all"]))
    scorer, jobs = Scorer(spec, random_bundle), [("score", vector, 3), ("score", -vector, 3)]
    assert scorer.score_all(jobs, lambda _: None)[0] == scorer.score(*jobs[0])
    assert (scorer.world.actions, spec.version) == (VARIANTS["all"].controls, 2)
    with pytest.raises(UsageError, match="dream"):
        Scorer(replace(spec, version=1), random_bundle)


@pytest.mark.parametrize(("task", "horizons"), [("dream", (20, 7, 20)), ("car-racing", (4, 2, 4))])
def test_a_group_is_scored_with_its_stages_horizon(random_bundle, task, horizons):
    spec = TaskSpec(task, random_bundle.sha256, horizons[0], 0)
    jobs = [("score", np.random.default_rng(1).normal(size=867).astype(np.float32), seed) for seed in (1, 2)]
    scorer = Scorer(spec, random_bundle)
    for horizon in horizons:
        scores = scorer.score_all(jobs, lambda _: None, spec.with_overrides(horizon=horizon))
        assert max(each.steps for each in scores) <= horizon
        assert scores == Scorer(spec.with_overrides(horizon=horizon), random_bundle).score_all(jobs, lambda _: None)


def test_evaluations_ignore_a_stages_horizon_and_patience(random_bundle):
    spec = TaskSpec("car-racing", random_bundle.sha256, 1000, 0)
    scorer, stage = Scorer(spec, random_bundle), spec.with_overrides(horizon=300, patience=40)
    configs = [scorer.episode_config(kind, 5, stage) for kind in ("score", "collect")]
    assert [(each.horizon, each.patience) for each in configs] == [(300, 40)] * 2
    assert scorer.episode_config("evaluate", 5, stage) == scorer.episode_config("evaluate", 5)


CAR = ("gas", "steer.abs", "brake.share", "steps")


def pole(*measures):
    return TaskSpec("gym:CartPole-v1", "", 30, 0, controller=ControllerShape(4, 2), measures=measures)


def measured(spec, parameters, bundle=None):
    return Scorer(spec, bundle).score("score", parameters, 1)


def test_a_numbered_action_is_measured_by_the_share_of_its_steps_which_changes_no_fitness():
    parameters = np.random.default_rng(1).normal(0, 1, 10).astype(np.float32)
    plain, found = (
        measured(pole(), parameters),
        measured(pole("steps", "action0", "action1", "action1.share"), parameters),
    )
    steps, left, right, share = found.measures
    assert steps == found.steps
    assert left + right == pytest.approx(1)
    assert 0 < right == share < 1
    assert (plain.fitness, plain.steps, plain.measures) == (found.fitness, found.steps, ())


@pytest.mark.parametrize(
    ("name", "named"), [("speed", "'speed'.* steps, action0, action0.abs"), ("truth.speed", "'truth.speed'")]
)
def test_a_measure_that_the_world_or_the_dream_lacks_is_refused(name, named):
    with pytest.raises(UsageError, match=named):
        Scorer(pole(name))
    bundle = find_bundle("tiny")
    with pytest.raises(UsageError, match=name):
        DreamBatch(bundle, TaskSpec("dream", bundle.sha256, 40, 0, measures=(name,)))


def test_a_number_that_the_last_info_lacks_is_the_episodes_failure():
    with pytest.raises(ValueError, match="'goal'"):
        measured(pole("info.goal"), np.zeros(10, np.float32))


def test_a_cars_speed_is_its_true_states_mean():
    bundle = find_bundle("tiny")
    spec = TaskSpec("car-racing", bundle.sha256, 60, 0, measures=("truth.speed", "gas", "brake.share"))
    speed, gas, braking = measured(spec, find_controller("tiny").parameters, bundle).measures
    assert 1 < speed < 100
    assert 0 < gas < 1
    assert 0 <= braking < 1


def test_a_dreams_measures_are_the_same_bits_in_any_batch():
    bundle, controller = find_bundle("tiny"), find_controller("tiny")
    spec = TaskSpec("dream", bundle.sha256, 40, 0, temperature=1.3)
    noise = np.random.default_rng(4).normal(0, 0.3, (6, len(controller.parameters)))
    dreams = [((controller.parameters + each).astype(np.float32), seed) for each in noise for seed in (1, 2)]
    measuring = DreamBatch(bundle, replace(spec, measures=CAR))
    together = measuring.score(dreams)
    assert len({each.measures for each in together}) == len(dreams)
    assert measuring.score(dreams[::-1])[::-1] == together
    assert [measuring.score([each])[0] for each in dreams] == together
    assert [each.fitness for each in together] == [each.fitness for each in DreamBatch(bundle, spec).score(dreams)]
    assert all(0 <= each.measures[0] <= 1 and each.measures[3] == each.steps for each in together)


def test_a_tally_counts_each_row_alone():
    measurer = Measurer(("gas", "gas.abs", "gas.share"), Continuous.between([-1, -1], [1, 1]), ("gas", "brake"))
    tally = measurer.begin(3)
    tally.add(np.array([0, 2]), np.array([[0.5, 0], [-1, 0]], np.float32))
    tally.add(np.array([2]), np.array([[1, 0]], np.float32))
    assert measurer.values(tally, 0, 1) == (0.5, 0.5, 1.0)
    assert measurer.values(tally, 2, 2) == (0.0, 1.0, 0.5)
    numbered = Measurer(("action1",), Discrete(2, first=5), ())
    tally = numbered.begin(1)
    for action in (6, 5, 6, 6):
        tally.add(np.array([0]), np.array([action]))
    assert numbered.values(tally, 0, 4) == (0.75,)


PROJECT = """
[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"
[project]
name = "field"
version = "1.0"
[tool.setuptools]
py-modules = ["field"]
"""


CODE = """
import numpy as np
from dreamfleet import Scorer, TaskSpec
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.protocol.tasks import describe_task
from dreamfleet.worker.tasks.registry import find_task, known_tasks
print("field" in known_tasks(), find_task("field").name, describe_task("field", {}).observations)
scorer = Scorer(TaskSpec("field", "", 20, 0, ControllerShape(2, 2)))
still, inwards = np.zeros(6, np.float32), np.array([-1, 0, 0, -1, 0, 0], np.float32)
print(scorer.score("score", inwards, 3).fitness > scorer.score("score", still, 3).fitness,
      scorer.score("evaluate", inwards, 3).steps)
"""


@pytest.mark.slow
def test_a_package_registers_a_task_that_needs_no_bundle_and_candidates_are_scored_in_it(tmp_path):
    page = (ROOT / "docs" / "reference" / "tasks.md").read_text()
    (module,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (points,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    assert len(module.splitlines()) - module.count("\n\n") <= 30, "thirty lines, blank ones aside"
    source, target = tmp_path / "source", tmp_path / "site"
    source.mkdir()
    (source / "field.py").write_text(module)
    (source / "pyproject.toml").write_text(PROJECT + points)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", target, source]
    subprocess.run(pip, check=True, timeout=DEADLINE, capture_output=True)
    surroundings = {**os.environ, "PYTHONPATH": f"{target}{os.pathsep}{ROOT}"}
    done = subprocess.run(
        [sys.executable, "-c", CODE], env=surroundings, capture_output=True, text=True, timeout=DEADLINE, check=False
    )
    assert (done.returncode, done.stdout.split()) == (0, ["True", "field", "2", "True", "20"]), done.stderr


class Nameless(Task):
    world = World(Continuous.between([-1], [1]))


class Worldless(Task):
    name = "worldless"

    def make_environment(self, assignment):
        raise AssertionError


class Bare:
    name = "bare"
    batch_size = 0
    world = "none"


@pytest.mark.parametrize(
    ("task", "named"),
    [("Nameless", "make_environment"), ("Worldless", "Worldless"), ("Bare", "make_environment.*make_policy")],
)
def test_an_incomplete_task_is_refused_with_what_is_missing(task, named):
    with pytest.raises(UsageError, match=named):
        find_task(f"{__name__}:{task}")
