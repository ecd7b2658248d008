import json
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.controller import Controller
from dreamfleet.common.errors import BundleError, ControllerError, DreamfleetError, UsageError
from dreamfleet.worker.scoring import episode
from dreamfleet.worker.scoring.episode import Course
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.tools.evaluation import Evaluated, bundle_for, evaluate
from tests.support import tasks

SEEDS = (10_000, 10_001, 10_002)


@pytest.fixture
def controller(random_bundle):
    def make(task=tasks.TOY):
        shape = random_bundle.controller_shape
        parameters = np.random.default_rng(0).normal(size=shape.size).astype(np.float32)
        return Controller(shape, parameters, task, random_bundle.sha256)

    return make


def test_scores_are_the_judges_whoever_drove_them(controller, random_bundle):
    task = find_task(tasks.JUDGED)
    alone = {
        seed: episode.score(
            task.make_judge(None), task.make_policy(None), controller().parameters, Course(seed, 10**6)
        ).fitness
        for seed in SEEDS
    }
    for jobs in (1, 2):
        assert dict(evaluate(controller(tasks.JUDGED), random_bundle, SEEDS, jobs)) == alone


@pytest.mark.parametrize(
    ("task", "error", "says"),
    [
        ("moon", UsageError, "unknown task 'moon'"),
        (tasks.CRASHING, DreamfleetError, "crashed"),
        (tasks.RAISING, RuntimeError, "road has ended"),
    ],
)
def test_what_goes_wrong_in_a_process_ends_the_evaluation_and_says_why(controller, random_bundle, task, error, says):
    with pytest.raises(error, match=says):
        list(evaluate(controller(task), random_bundle, SEEDS, 2))


def test_a_world_model_is_found_beside_its_controller_or_by_name(controller, random_bundle):
    assert bundle_for(controller(), str(random_bundle.path)).sha256 == random_bundle.sha256
    assert bundle_for(controller(), None, random_bundle.path).sha256 == random_bundle.sha256
    with pytest.raises(BundleError, match="is not the world model that is wanted"):
        bundle_for(replace(controller(), bundle="ab" * 32), None, random_bundle.path)
    with pytest.raises(BundleError, match="name it with --bundle"):
        bundle_for(controller(), None)


def test_a_controller_that_does_not_fit_is_refused(random_bundle):
    small = Controller(type(random_bundle.controller_shape)(4), np.zeros(15, np.float32), "car-racing", "ab" * 32)
    with pytest.raises(ControllerError, match="15 parameters"):
        bundle_for(small, str(random_bundle.path))


def test_the_verb_reports_every_score_and_warns_of_tracks_that_are_no_test_tracks(
    processes, controller, random_bundle, tmp_path
):
    controller().save(tmp_path / "toy.npz")
    code, out, err = processes.call(
        "evaluate", "--controller", tmp_path / "toy.npz", "--bundle", random_bundle.path, "--episodes", 2,
        "--first-seed", 9_999, "--jobs", 1, "--json",
    )  # fmt: skip
    report = json.loads(out)
    assert code == 0
    assert "test tracks are 10000 to 19999" in err
    assert report["seeds"] == [9_999, 10_000]
    assert report["mean"] == pytest.approx(sum(report["scores"]) / 2)
    assert (report["task"], report["bundle"]) == (tasks.TOY, random_bundle.sha256)


def test_the_summary_is_mean_and_standard_deviation():
    done = Evaluated((1, 2), (100.0, 300.0))
    assert (done.mean, done.std) == (200.0, 100.0)
