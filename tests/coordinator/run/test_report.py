"""The reported controller: present from the first closed generation on, and in step with the journal."""

from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.errors import ControllerError
from dreamfleet.common.protocol.stop_kind import StopKind, StopReason
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.coordinator.run.report import SAVE_INTERVAL
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.start import find_start
from tests.support.reporting_runs import EVALUATED, Reporting


@pytest.fixture
def make(make_bench):
    return lambda settings=EVALUATED, generations=100: make_bench(Reporting, settings, generations)


def test_a_mean_without_evaluation_is_saved_at_once_at_intervals_and_as_the_coordinator_leaves(make):
    bench = make(replace(EVALUATED, evaluate_every=0))
    assert bench.saved() is None
    bench.close(3)
    assert bench.saved().provenance["generation"] == 0, "that of the first closed one"
    bench.now += SAVE_INTERVAL
    bench.close(4)
    assert bench.saved().provenance["generation"] == 3
    bench.close(5)
    bench.run.leave()
    assert bench.saved().provenance["generation"] == 4


def test_after_every_evaluation_the_file_holds_the_best_evaluated_mean(make):
    bench = make()
    bench.close(2)
    named = ("generation", "confirmed", "validation_mean", "validation_episodes")
    assert [bench.saved().provenance[each] for each in named] == [1, False, 10.0, 2]
    bench.now += SAVE_INTERVAL
    bench.close(4)
    assert bench.saved().provenance["generation"] == 1
    bench.run.commit()
    vector = bench.journal.evaluated_vector(1)
    assert np.array_equal(bench.saved().parameters, np.frombuffer(vector, "<f4"))


def test_the_report_survives_a_restart(make):
    bench = make()
    bench.close(3)
    bench.run.leave()
    before = bench.saved()
    (bench.path / CONTROLLER).unlink()
    bench.restart()
    bench.run.leave()
    after = bench.saved()
    assert (after.sha256, after.provenance) == (before.sha256, before.provenance)


@pytest.mark.parametrize("every", [0, 2])
def test_a_run_that_resumes_beyond_its_limit_writes_the_controller_and_the_reason(make, every):
    bench = make(replace(EVALUATED, evaluate_every=every))
    bench.close(3)
    (bench.path / CONTROLLER).unlink()
    bench.limits = LimitsConfig(generations=2)
    bench.restart()
    assert bench.run.state.ended == StopReason(StopKind.GENERATIONS, "3 generations")
    assert bench.saved() is not None
    with RunFolder(bench.path) as stored:
        assert stored.ended == "3 generations"


def test_an_open_run_has_a_controller_once_a_generation_is_closed(make):
    bench = make()
    with pytest.raises(ControllerError, match=bench.path.name):
        find_controller(bench.path.name, bench.path.parent)
    bench.close(1)
    controller, beside = find_controller(bench.path.name, bench.path.parent)
    assert controller.sha256 == bench.run.background_jobs.report.current.controller().sha256
    assert beside is not None
    assert beside.exists()


def test_a_new_run_starts_from_the_mean_of_an_open_run_and_from_the_report_of_an_ended_one(make):
    bench = make()
    bench.close(3)
    opened = find_start(bench.path.name, bench.path.parent)
    assert opened.source.startswith("run ")
    bench.limits = LimitsConfig(generations=1)
    bench.restart()
    assert bench.run.state.ended is not None
    ended = find_start(bench.path.name, bench.path.parent)
    assert np.array_equal(ended.mean, bench.saved().parameters.astype(np.float64))
    assert not np.array_equal(opened.mean, ended.mean)
