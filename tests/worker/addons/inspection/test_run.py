"""A run's page: its own world model under its own controller."""

from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.common.runs.records import RunSettings, StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.coordinator.jobs.evaluation import Evaluation
from dreamfleet.coordinator.jobs.scoring_job import vector_bytes
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.worker.addons.inspection import measurements, verb
from dreamfleet.worker.addons.inspection.dream_comparisons import LossReport, RoadLossComparison
from dreamfleet.worker.addons.inspection.encoded_rollout import DriveConfig, record_drive
from dreamfleet.worker.addons.inspection.page_builder import write_page
from dreamfleet.worker.addons.inspection.probe import Estimate
from dreamfleet.worker.addons.inspection.subject import find_subject
from tests.support.samples import SPEC
from tests.support.variants import controller_of
from tests.support.verbs import run_verb

COMPARED = RoadLossComparison("40 steps before", 30, {"lost": {"reality": Estimate(1.0, 0.0)}})


@pytest.fixture
def runs_dir(tmp_path, random_bundle):
    path = tmp_path / "runs" / "night"
    path.mkdir(parents=True)
    shape = random_bundle.controller_shape
    spec = replace(SPEC, bundle=random_bundle.sha256, temperature=1.25)
    settings = RunSettings(spec, shape, 2, 1, 0.1, "diagonal", 1, 1, 2)
    journal = Journal.create(path, settings, random_bundle.path)
    vectors = [vector_bytes(np.full(shape.size, value)) for value in (0.5, 1.5)]
    for number in range(3):
        journal.open_generation(number, b"", 0.1, [7], vectors)
        closed = StoredGeneration(number, number, 1.0, number + 1, 0.0, 0.1, 20, 1.0)
        journal.close_generation(closed, np.array([0.0, 1.0]))
        journal.schedule_evaluation(Evaluation(number, vectors[0], 2))
        journal.finish_evaluation(number, StoredEvaluation(number, 4, 100.0 * number, 5.0), 0)
    journal.commit()
    journal.close()
    return tmp_path / "runs"


def end(runs_dir, bundle):
    """Keep a controller of the run, which has ended."""
    controller = controller_of(bundle, "dream")
    controller.save(runs_dir / "night" / CONTROLLER)
    return controller


@pytest.mark.slow
def test_a_run_that_goes_on_is_driven_at_random_and_one_that_has_ended_by_its_controller(
    runs_dir, random_bundle, tmp_path
):
    with find_subject("night", runs_dir) as subject:
        assert subject.controller is None
        assert 'id="fitness"' in write_page(subject, tmp_path / "out", DriveConfig(steps=4)).read_text()
    controller = end(runs_dir, random_bundle)
    with find_subject("night", runs_dir) as subject:
        assert subject.controller.sha256 == controller.sha256


def test_a_bundle_is_shown_a_drive_of_another_ones_controller(random_bundle, tmp_path):
    controller, _ = find_controller("tiny", tmp_path)
    own = find_bundle("tiny")
    seen, driven = (record_drive(each, controller, DriveConfig(steps=30), own) for each in (random_bundle, own))
    assert np.array_equal(seen.action, driven.action)
    assert not np.array_equal(seen.mu, driven.mu)


def test_a_runs_own_controller_is_measured_at_the_runs_temperature(runs_dir, random_bundle, monkeypatch):
    asked = []
    report = LossReport(1, 8, 1.0, 10, (COMPARED,))
    monkeypatch.setattr(measurements, "collect_losing_drives", lambda *_given: [])
    monkeypatch.setattr(measurements, "compare_losses", lambda *given: asked.append(given) or report)
    end(runs_dir, random_bundle)
    for flags, temperature in ((), 1.25), (("--temperature", "1.5"), 1.5):
        assert run_verb(verb, "night", "--losses", *flags, runs_dir=runs_dir) == 0
        _, bundle, controller, losses, _ = asked.pop()
        assert bundle.sha256 == controller.bundle == random_bundle.sha256
        assert losses.temperature == temperature
