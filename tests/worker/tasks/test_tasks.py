"""Tests api.py, assignment.py, batches.py, policy.py, common/protocol/tasks.py and worker/scoring/scorer.py."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import BundleManifest, write_bundle
from dreamfleet.common.artifacts.car_racing_variants import FACTS, Variant
from dreamfleet.common.errors import BundleError, ControllerError, UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import check_task, describe_task, is_self_describing
from dreamfleet.worker.scoring.episode import run_episode, score
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX, RAW
from tests.support.bundles import npy, write_random_bundle
from tests.support.variants import VARIANTS


@pytest.mark.parametrize(
    ("name", "named"),
    [("moon", "car-racing"), ("tests.support.tasks:Moon", "Moon"), ("no.such:Task", "no")],
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


@pytest.mark.parametrize(
    ("name", "named"),
    [
        ("CarRacing-v3", "car-racing"),
        ("carracing", "car-racing"),
        ("LunarLander-v3", "gym.LunarLander-v3"),
        ("car-racin", "car-racing"),
    ],
)
def test_a_name_of_gymnasium_is_answered_with_ours(name, named):
    with pytest.raises(UsageError, match=named):
        check_task(name)


def test_only_a_missing_module_is_to_be_installed():
    with pytest.raises(UsageError) as refused:
        describe_task("gym:tests.support.tasks:Fields-v0", {})
    assert "install" not in str(refused.value)


@pytest.mark.parametrize("task", ["car-racing", "dream"])
@pytest.mark.parametrize(
    ("of", "preprocessing", "shape"),
    [
        ("moon", "box-64", (64, 64, 3)),
        ("car-racing", "none", (64, 64, 3)),
        ("car-racing", "raw-96", (64, 64, 3)),
        ("car-racing", "box-64", (96, 96, 3)),
    ],
)
def test_a_bundle_of_another_task_or_of_pictures_that_it_does_not_give_is_refused(
    tmp_path, task, of, preprocessing, shape
):
    parts = dict.fromkeys(("encoder.onnx", "decoder.onnx", "dream.onnx"), b"x")
    parts["initial_latents.npy"] = npy(np.zeros((1, 2, 4), np.float32))
    manifest = BundleManifest("moon", of, preprocessing, shape, latent=4, hidden=4, actions=3, world=FACTS)
    bundle, found = write_bundle(tmp_path / "moon.zip", manifest, parts), find_task(task)
    for make in (found.make_environment, found.make_evaluation_environment, found.make_policy):
        asked = task == "dream" and of == "moon"  # the dream asks the bundle's own world
        named = "moon" if asked else f"'{of}' .*'{preprocessing}'"
        with pytest.raises(UsageError if asked else BundleError, match=named):
            make(Assignment.of(task, bundle))


@pytest.mark.slow
@pytest.mark.parametrize("preprocessing", [BOX, RAW])
def test_both_environments_observe_gymnasiums_pictures_preprocessed(tmp_path, preprocessing):
    vae = VAEConfig(picture=preprocessing.size, latent=4, channels=(2, 2, 2, 2))
    bundle = write_random_bundle(tmp_path / "b.zip", vae=vae, rnn=MDNRNNConfig(latent=4, hidden=4))
    task, plain = find_task("car-racing"), gymnasium.make("CarRacing-v3")
    assignment = Assignment.of("car-racing", bundle)
    ours = [task.make_environment(assignment), task.make_evaluation_environment(assignment)]
    observed, _ = plain.reset(seed=10_000)
    seen = [each.reset(seed=10_000)[0] for each in ours]
    action = np.array([0.1, 0.5, 0.0], np.float32)
    for _ in range(60):  # past the opening's zoom
        assert all((each == preprocessing.picture(observed)).all() for each in seen)
        observed, reward, *_ = plain.step(action)
        steps = [each.step(action) for each in ours]
        assert [each[1] for each in steps] == [reward, reward]
        seen = [each[0] for each in steps]
    for each in (*ours, plain):
        assert each.observation_space.contains(each.reset(seed=1)[0])
        each.close()


def test_an_episode_does_not_depend_on_earlier_ones(random_bundle):
    policy = find_task("car-racing").make_policy(Assignment.of("car-racing", random_bundle))
    random = np.random.default_rng(1)
    parameters = random.normal(size=random_bundle.controller_shape.size).astype(np.float32)
    pictures = random.integers(0, 256, (5, 64, 64, 3), dtype=np.uint8)
    episodes = []
    for _ in range(2):
        policy.begin(parameters)
        episodes.append(np.stack([policy.act(each) for each in (*pictures, pictures[0])]))
    assert (episodes[0] == episodes[1]).all()
    assert (episodes[0][0] != episodes[0][-1]).any(), "the state changes what the same picture leads to"


def test_a_job_is_scored_with_the_controller_shape_of_its_run(random_bundle):
    shape = random_bundle.shape_of("z", 4)
    scorer = Scorer(TaskSpec("car-racing", random_bundle.sha256, 5, 0, shape), random_bundle)
    assert scorer.score("score", np.zeros(shape.size, np.float32), 3).steps == 5
    with pytest.raises(ControllerError, match="867 parameters"):
        scorer.score("score", np.zeros(867, np.float32), 3)
    scorer.close()


def varied(bundle, task="car-racing", horizon=5, **named):
    """A specification with a variant, and a parameter vector."""
    variant = Variant(**named)
    shape = bundle.shape_of("zh", 0, variant)
    spec = TaskSpec(task, bundle.sha256, horizon, 0, shape, options=variant.options, version=variant.version)
    return spec, np.random.default_rng(1).normal(0, 0.1, shape.size).astype(np.float32)


def judged(spec, bundle, vector, episode_config):
    """The score of an episode in the task's evaluation environment."""
    task, assignment = find_task(spec.task), Assignment(spec, bundle)
    judge = task.make_evaluation_environment(assignment)
    found = score(judge, task.make_policy(assignment), vector, episode_config)
    judge.close()
    return found


@pytest.mark.parametrize("name", VARIANTS)
def test_a_job_is_scored_with_the_variant_of_its_run(random_bundle, name):
    spec, vector = varied(random_bundle, **vars(VARIANTS[name]))
    scorer = Scorer(spec, random_bundle)
    scores = [scorer.score("score", vector, 3) for _ in range(2)]
    assert scores[0] == scores[1]
    scorer.close()
    assert judged(spec, random_bundle, vector, scorer.episode_config("score", 3)) == scores[0]


def test_only_candidates_pay_for_time(random_bundle):
    (plain, vector), (dear, _) = varied(random_bundle), varied(random_bundle, time_cost=0.5)
    scorers = [Scorer(each, random_bundle) for each in (plain, dear)]
    free, paid = (each.score("score", vector, 3).fitness for each in scorers)
    assert free - paid == pytest.approx(0.5 * 5)
    for kind in ("evaluate", "collect"):
        assert scorers[1].episode_config(kind, 3) == scorers[0].episode_config(kind, 3)
    for each in scorers:
        each.close()


def test_only_candidates_pay_for_steps_off_the_road(random_bundle):
    (plain, vector), (dear, _) = (varied(random_bundle, horizon=150, **each) for each in ({}, {"offroad_cost": 2.0}))
    vector = np.zeros_like(vector)
    vector[-3:] = 1, 2, -1  # gas, and always to one side
    scorers = [Scorer(each, random_bundle) for each in (plain, dear)]
    free, paid = (each.score("score", vector, 3) for each in scorers)
    assert free.steps == paid.steps
    assert 2 <= free.fitness - paid.fitness <= 200
    for kind in ("evaluate", "collect"):
        assert scorers[1].episode_config(kind, 3).off_course_cost == 0
    assert judged(dear, random_bundle, vector, scorers[1].episode_config("score", 3)) == paid
    dream, _ = varied(random_bundle, "dream", horizon=150, offroad_cost=2.0)
    scorers.append(Scorer(dream, random_bundle))
    assert scorers[2].score("score", vector, 3, spec=dream.with_overrides(driven=True)) == paid
    for each in scorers:
        each.close()


def test_a_lap_that_is_over_costs_no_more_time(random_bundle):
    episode_config = Scorer(varied(random_bundle, time_cost=0.5)[0], random_bundle).episode_config("score", 3)
    assert (episode_config.time_cost, episode_config.finish) == (0.5, "lap_finished")
    environment = find_task("car-racing").make_environment(Assignment.of("car-racing", random_bundle))

    class HomeAtOnce:
        """Moves the lap's end under the car."""

        def act(self, _observation):
            environment.unwrapped.tile_visited_count = len(environment.unwrapped.track)
            return np.zeros(3, np.float32)

    *_, last = run_episode(environment, HomeAtOnce(), episode_config)
    assert last.ended
    assert last.info["lap_finished"]
    environment.close()


def test_a_variant_is_another_version_of_the_task(random_bundle):
    spec, _ = varied(random_bundle, decide_every=4)
    assert (spec.version, spec.controller) == (2, random_bundle.default_shape)
    with pytest.raises(UsageError, match="car-racing"):
        Scorer(replace(spec, version=1), random_bundle)


def test_a_variant_is_dreamt_and_driven(random_bundle):
    spec, vector = varied(random_bundle, "dream", 20, **vars(VARIANTS["all"]))
    scorer = Scorer(spec, random_bundle)
    alone = scorer.score("score", vector, 3)
    assert scorer.score_all([("score", vector, 3), ("score", -vector, 3)], lambda _: None)[0] == alone
    assert scorer.world.actions == VARIANTS["all"].controls
    scorer.close()


@pytest.mark.parametrize(("task", "horizons"), [("dream", (20, 7, 20)), ("car-racing", (4, 2, 4))])
def test_a_group_is_scored_with_its_stages_horizon(random_bundle, task, horizons):
    spec = TaskSpec(task, random_bundle.sha256, horizons[0], 0)
    jobs = [("score", np.random.default_rng(1).normal(size=867).astype(np.float32), seed) for seed in (1, 2)]
    scorer = Scorer(spec, random_bundle)
    for horizon in horizons:
        scores = scorer.score_all(jobs, lambda _: None, spec.with_overrides(horizon=horizon))
        assert max(each.steps for each in scores) <= horizon
        assert scores == Scorer(spec.with_overrides(horizon=horizon), random_bundle).score_all(jobs, lambda _: None)
    scorer.close()


def test_evaluations_ignore_a_stages_horizon_and_patience(random_bundle):
    spec = TaskSpec("car-racing", random_bundle.sha256, 1000, 0)
    scorer, stage = Scorer(spec, random_bundle), spec.with_overrides(horizon=300, patience=40)
    for kind in ("score", "collect"):
        episode_config = scorer.episode_config(kind, 5, stage)
        assert (episode_config.horizon, episode_config.patience) == (300, 40)
    assert scorer.episode_config("evaluate", 5, stage) == scorer.episode_config("evaluate", 5)
    scorer.close()


@pytest.mark.parametrize("name", ["os:abort", "sys:exit", "tests.support.tasks:steps_made"])
def test_what_is_no_class_is_never_called_as_a_task(name):
    with pytest.raises(UsageError):
        find_task(name)
