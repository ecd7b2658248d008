"""The receipt in a reported controller: drawn up from the journal, and enough to begin the run again.
Tests dreamfleet/experiments/rerun.py."""

import json
import sys
from dataclasses import asdict, replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import ControllerError, JournalError, UsageError
from dreamfleet.common.runs.effort import START_EFFORT, Effort
from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.common.runs.run_provenance import read_run_provenance, read_run_settings
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.settings.resume_settings import serving_facts
from dreamfleet.coordinator.settings.start import StartPoint, find_start
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.experiments.rerun import Rerun
from tests.support.dispatched import result
from tests.support.reporting_runs import EVALUATED, Reporting


class Spending(Reporting):
    """Each result took a tenth of a second and ten steps."""

    start = None

    def begin(self):
        if self.start is not None:
            for name, text in {**self.start.facts, **serving_facts(self.limits, NetworkConfig())}.items():
                self.journal.set_fact(name, text)
            self.journal.commit()
        super().begin()

    def end(self):
        super().end()
        return Controller.load(self.path / CONTROLLER)


@pytest.fixture
def make(make_bench):
    return lambda start=None, **changes: make_bench(
        type("One", (Spending,), {"start": start}), replace(EVALUATED, **changes), 4
    )


def test_it_holds_generations_effort_fingerprint_versions_and_seeds(make):
    bench = make()
    receipt = read_run_provenance(bench.end())
    settings = bench.settings
    scored = 4 * settings.population * settings.episodes
    assert receipt.generations == 4
    assert receipt.effort == Effort(10 * scored, 10 * 2 * 2, 0, 100_000 * (scored + 4))
    assert (receipt.fingerprint, receipt.mixed, receipt.start) == ("f", False, None)
    assert {"dreamfleet", "numpy", "cma", "python"} <= receipt.versions.keys()
    assert receipt.seeds == {"evaluation": (20_000, 2)}
    assert read_run_settings(bench.saved()) == settings


def test_effort_is_counted_on_once_a_result_as_it_would_be_summed_up(make):
    bench = make()
    before = bench.journal.results.effort
    (_, job), *_ = bench.fetch()
    bench.step()
    bench.answer(result(job.digest))
    assert bench.journal.results.effort == before + Effort(10, 0, 0, 100_000)
    again = Journal(bench.path / "journal.sqlite")
    assert again.results.effort == bench.journal.results.effort
    again.close()


def test_a_start_is_in_it_whole_with_what_had_been_spent(make, tmp_path):
    size = EVALUATED.controller.size
    start = StartPoint(np.linspace(0, 1, size), EVALUATED.task.bundle, "controller a", "", Effort(5, 6, 7, 8))
    bench = make(start)
    found = read_run_provenance(bench.end())
    assert np.array_equal(found.start.vector, start.mean)
    assert (found.start.source, found.start.effort, found.mixed) == ("controller a", start.effort, False)
    assert found.total == start.effort + found.effort
    follower = find_start(str(bench.path / CONTROLLER), tmp_path)
    assert follower.effort == found.total
    assert json.loads(follower.facts[START_EFFORT])["driven"] == found.total.driven


def test_a_start_of_unknown_origin_has_no_effort(tmp_path, random_bundle):
    shape = random_bundle.controller_shape
    Controller(shape, np.zeros(shape.size, np.float32), "dream", random_bundle.sha256).save(tmp_path / "a.npz")
    start = find_start(str(tmp_path / "a.npz"), tmp_path)
    assert start.effort is None
    assert START_EFFORT not in start.facts


def test_what_ships_can_be_begun_again_as_it_was(tmp_path):
    controller, _ = find_controller("tiny", tmp_path)
    bundle = find_bundle_of(controller, None)
    again = Rerun.of(controller, bundle)
    config, kept = again.plan(tmp_path / "tiny-again")
    assert freeze(config, bundle) == read_run_settings(controller)
    assert (again.limits, again.start) == (LimitsConfig(generations=25), None)
    assert kept == {"failure_limit": 1.0}, "the first run went on, whatever failed"
    assert again.expected_difference  # it is from before receipts


def test_another_run_is_not_gone_on_with_and_another_version_is_named(tmp_path, random_bundle):
    controller, settings = begun(random_bundle, population=6), freeze(RunConfig(population=5), random_bundle)
    folder = tmp_path / "other"
    folder.mkdir()
    Journal.create(folder, settings, random_bundle.path).close()
    again = Rerun.of(controller, random_bundle)
    with pytest.raises(UsageError, match=r"other .*--run"):
        again.plan(folder)
    strange = replace(again, settings=replace(again.settings, packages=("rocks",)))
    with pytest.raises(UsageError, match="packages"):
        strange.plan(tmp_path / "new")


def begun(bundle, **changes):
    """A controller of a run that has just begun."""
    settings = freeze(RunConfig(**changes), bundle)
    provenance = {"settings": asdict(settings), "generation": 0, "steps": 10}
    still = np.zeros(settings.controller.size, np.float32)
    return Controller(settings.controller, still, settings.task.task, bundle.sha256, provenance)


def test_a_run_that_closed_nothing_cannot_be_repeated(random_bundle):
    controller = begun(random_bundle)
    provenance = {**controller.provenance, "receipt": {"generations": 0, "effort": {}}}
    with pytest.raises(ControllerError):
        Rerun.of(replace(controller, provenance=provenance), random_bundle)


def test_no_file_chooses_what_is_imported(random_bundle, tmp_path):
    again = Rerun.of(begun(random_bundle), random_bundle)
    strange = replace(again, settings=replace(again.settings, optimiser="antigravity:fly"))
    with pytest.raises(UsageError, match=r"--trust.* antigravity"):
        strange.plan(tmp_path / "again")
    assert "antigravity" not in sys.modules


@pytest.mark.slow
def test_a_run_is_compared_with_another_that_began_alike_and_why_they_differ_is_said_as_far_as_it_is_known(make):
    first, second = make(), make(seed=2)
    again = Rerun.of(first.end(), None)
    second.end()
    elsewhere = StartPoint(np.ones(first.settings.controller.size), first.settings.task.bundle, "elsewhere")
    for other in (first, make(elsewhere)):
        with pytest.raises(UsageError, match=f"{other.path.name} .*--run"):
            again.plan(other.path)
    assert again.plan(make().path)[0] is None
    assert again.compare(first.path).same
    found = again.compare(second.path)
    assert not found.same
    reasons = {found.why}
    for changes in ({"mixed": True}, {"fingerprint": None}, {"fingerprint": "g"}, {"versions": {"cma": "1"}}):
        other = replace(again, receipt=replace(again.receipt, **changes))
        reasons.add(other.compare(second.path).why)
    assert len(reasons) == 5
    with pytest.raises(JournalError):
        again.compare(first.path.parent)


@pytest.mark.slow
def test_whether_hosts_of_the_second_time_are_of_the_first_ones_class_is_said(make):
    first, second = make(), make(seed=2)
    first.host_class, second.host_class = "a" * 16, "b" * 16
    controller = first.end()
    second.end()
    assert not read_run_provenance(controller).classes.mixed
    again = Rerun.of(controller, None)
    assert again.compare(first.path).same
    for each in ("a", "b"):
        assert each * 16 in again.compare(second.path).summary
