"""Tests evaluation.py, evaluation_report.py, verb.py and worker/addons/verification/report_verb.py."""

import json
import os
import re
import signal
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import BundleError, ControllerError, DreamfleetError, UsageError
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.runs.episode_results import EpisodeResults
from dreamfleet.common.runs.lookup import find_bundle_of
from dreamfleet.worker.addons.evaluation.agents import make_agent
from dreamfleet.worker.addons.evaluation.evaluation import evaluate, evaluate_in_processes
from dreamfleet.worker.addons.evaluation.evaluation_report import read_evaluation_report
from dreamfleet.worker.scoring import episode
from dreamfleet.worker.scoring.episode import EpisodeConfig
from dreamfleet.worker.tasks.registry import find_task
from tests.support import rough_tasks, tasks
from tests.support.processes import call_here

SEEDS = (10_000, 10_001, 10_002)


@pytest.fixture
def controller(random_bundle):
    def make(task=tasks.TOY):
        shape = random_bundle.controller_shape
        parameters = np.random.default_rng(0).normal(size=shape.size).astype(np.float32)
        return Controller(shape, parameters, task, random_bundle.sha256)

    return make


def test_scores_are_those_of_the_evaluation_environment(controller, random_bundle):
    task = find_task(tasks.JUDGED)
    alone = {
        seed: episode.score(
            task.make_evaluation_environment(None),
            task.make_policy(None),
            controller().parameters,
            EpisodeConfig(seed, 10**6),
        ).fitness
        for seed in SEEDS
    }
    for jobs in (1, 2):
        drives = list(evaluate(make_agent(controller(tasks.JUDGED), random_bundle), SEEDS, jobs))
        assert {each.seed: each.score for each in drives} == alone
        assert {each.steps for each in drives} == {10}


@pytest.mark.parametrize(
    ("task", "error", "named"),
    [
        ("moon", UsageError, "'moon'"),
        (tasks.CRASHING, DreamfleetError, "SIGSEGV"),
        (tasks.RAISING, DreamfleetError, "seed 10000, RuntimeError: the road has ended"),
    ],
)
def test_an_error_in_a_process_ends_the_evaluation_with_the_reason(controller, random_bundle, task, error, named):
    with pytest.raises(error, match=named):
        EpisodeResults.of(evaluate(make_agent(controller(task), random_bundle), SEEDS, 2))


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_an_episode_that_fails_is_reported_and_the_others_go_on(processes, controller, random_bundle, tmp_path, jobs):
    controller(tasks.BRITTLE).save(tmp_path / "toy.npz")
    evaluation = (
        "evaluate", "--controller", tmp_path / "toy.npz", "--bundle", random_bundle.path, "--episodes", 30, "--jobs",
        jobs, "--out", tmp_path / "toy.json",
    )  # fmt: skip
    code, out, err = processes.call(*evaluation)
    report = read_evaluation_report(tmp_path / "toy.json")
    failed = len(report.failed)
    assert (code, 0 < failed < 30, len(report.drives) + failed) == (0, True, 30), err
    assert f"seed {report.failed[0].seed}, ArithmeticError: the" in out
    assert "Traceback" not in err
    for each in report.failed:
        assert f"seed {each.seed}, ArithmeticError: the world of" in err
    plain = json.loads((tmp_path / "toy.json").read_text())
    assert plain["mean"] == pytest.approx(np.mean([each["score"] for each in plain["drives"]]))
    assert (plain["n"], [each["seed"] for each in plain["failed"]]) == (
        30 - failed,
        [each.seed for each in report.failed],
    )
    code, out, err = call_here(
        "verify", "report", tmp_path / "toy.json", "--bundle", random_bundle.path, "--jobs", jobs
    )
    assert (code, f"{30 - failed} bit-identical scores" in out) == (0, True), err


@pytest.mark.slow
def test_an_evaluation_without_any_score_ends_with_one_line(processes, controller, random_bundle, tmp_path):
    controller(tasks.NAN).save(tmp_path / "toy.npz")
    code, out, err = processes.call(
        "evaluate", "--controller", tmp_path / "toy.npz", "--bundle", random_bundle.path, "--episodes", 5, "--jobs", 1
    )
    assert (code, out, "Traceback" in err) == (1, "", False)
    assert "seed 10000, ValueError: " in err


def test_a_crash_costs_only_its_own_episode(controller, random_bundle):
    found = EpisodeResults.of(evaluate(make_agent(controller(tasks.FRAGILE), random_bundle), tuple(range(8)), 2))
    assert [each.seed for each in found.failed] == [6]
    assert len(found.drives) == 7


@pytest.mark.slow
@pytest.mark.parametrize("poison", ["fail", "segfault"])
def test_an_episode_fails_only_in_a_fresh_process(controller, random_bundle, monkeypatch, poison):
    monkeypatch.setenv(rough_tasks.POISON, poison)
    agent = make_agent(controller(rough_tasks.name_of(rough_tasks.Poisoned)), random_bundle)
    alone, beside = (EpisodeResults.of(evaluate_in_processes(agent, tuple(range(4)), jobs)) for jobs in (1, 2))
    assert (len(alone.drives), alone.failed) == (4, ())
    assert sorted(alone.drives, key=lambda each: each.seed) == sorted(beside.drives, key=lambda each: each.seed)


def test_in_the_own_process_an_episode_fails_only_in_a_fresh_environment(controller, random_bundle):
    agent = make_agent(controller(rough_tasks.name_of(rough_tasks.Wearing)), random_bundle)
    assert len(EpisodeResults.of(evaluate(agent, tuple(range(4)), 1)).drives) == 4


@pytest.mark.parametrize("error", ["KeyboardInterrupt", "GeneratorExit"])
def test_what_only_python_itself_should_raise_is_an_episodes_failure(
    processes, controller, random_bundle, tmp_path, monkeypatch, error
):
    monkeypatch.setenv(rough_tasks.PLACE, "step")
    monkeypatch.setenv(rough_tasks.ERROR, error)
    controller(rough_tasks.name_of(rough_tasks.Raising)).save(tmp_path / "toy.npz")
    judged = ("--controller", tmp_path / "toy.npz", "--bundle", random_bundle.path, "--episodes", 2, "--jobs", 1)
    code, out, err = processes.call("evaluate", *judged, "--trust", rough_tasks.MODULE)
    assert (code, out, "Traceback" in err) == (1, "", False), err
    assert f"seed 10000, {error}: " in err


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_an_episode_that_hangs_is_given_up_and_the_others_go_on(controller, random_bundle, monkeypatch, jobs):
    monkeypatch.setenv(rough_tasks.HALT, "5")
    monkeypatch.setenv(rough_tasks.EXIT, "2")
    agent = make_agent(controller(rough_tasks.name_of(rough_tasks.Halting)), random_bundle)
    found = EpisodeResults.of(evaluate_in_processes(agent, tuple(range(8)), jobs, stall=2.0))
    crashed, hung = sorted(found.failed, key=lambda each: each.seed)
    assert (crashed.seed, "exit status 3" in crashed.error, hung.seed) == (2, True, 5)
    assert len(found.drives) == 6


def test_the_verb_outlives_a_simulator_that_ends_its_only_process(
    processes, controller, random_bundle, tmp_path, monkeypatch
):
    monkeypatch.setenv(rough_tasks.EXIT, "10000")
    controller(rough_tasks.name_of(rough_tasks.Halting)).save(tmp_path / "toy.npz")
    judged = ("--controller", tmp_path / "toy.npz", "--bundle", random_bundle.path, "--episodes", 3, "--jobs", 1)
    code, out, err = processes.call("evaluate", *judged, "--trust", rough_tasks.MODULE)
    assert (code, "seed 10000" in out, "exit status 3" in out) == (0, True, True), err


def test_an_interrupted_evaluation_says_what_it_has(processes, controller, random_bundle, tmp_path, monkeypatch):
    monkeypatch.setenv(rough_tasks.EXIT, "10003")
    monkeypatch.setenv(rough_tasks.HALT, "10004")
    controller(rough_tasks.name_of(rough_tasks.Halting)).save(tmp_path / "toy.npz")
    judged = ("--controller", tmp_path / "toy.npz", "--bundle", random_bundle.path, "--episodes", 5, "--jobs", 1)
    evaluation = processes.start("evaluate", *judged, "--trust", rough_tasks.MODULE)
    evaluation.wait_for("seed 10003")
    os.killpg(evaluation.popen.pid, signal.SIGINT)  # as a terminal does
    assert evaluation.finish()[0] == 130
    assert re.search(r"\b3 .*\b5 .*-\d.*±", evaluation.last_line()), evaluation.last_line()


def test_a_world_model_is_found_beside_its_controller_or_by_name(controller, random_bundle):
    assert find_bundle_of(controller(), str(random_bundle.path)).sha256 == random_bundle.sha256
    assert find_bundle_of(controller(), None, random_bundle.path).sha256 == random_bundle.sha256
    with pytest.raises(BundleError):
        find_bundle_of(replace(controller(), bundle="ab" * 32), None, random_bundle.path)
    with pytest.raises(BundleError, match="--bundle"):
        find_bundle_of(controller(), None)


def test_a_controller_that_does_not_fit_is_refused(random_bundle):
    small = Controller(type(random_bundle.controller_shape)(4, 3), np.zeros(15, np.float32), "car-racing", "ab" * 32)
    with pytest.raises(ControllerError, match="15"):
        find_bundle_of(small, str(random_bundle.path))


def test_the_verb_reports_every_score_and_warns_about_tracks_outside_the_test_set(
    processes, controller, random_bundle, tmp_path
):
    controller().save(tmp_path / "toy.npz")
    code, out, err = processes.call(
        "evaluate", "--controller", tmp_path / "toy.npz", "--bundle", random_bundle.path, "--episodes", 2,
        "--first-seed", 9_999, "--jobs", 1, "--json",
    )  # fmt: skip
    report = json.loads(out)
    assert code == 0
    assert "19999" in err
    assert report["seeds"] == [9_999, 10_000]
    assert report["mean"] == pytest.approx(sum(report["scores"]) / 2)
    assert (report["task"], report["bundle"]) == (tasks.TOY, random_bundle.sha256)


@pytest.mark.slow
def test_the_report_is_what_it_prints_and_can_be_repeated_to_the_bit(processes, controller, random_bundle, tmp_path):
    controller().save(tmp_path / "toy.npz")
    (tmp_path / "bundle.zip").write_bytes(random_bundle.path.read_bytes())
    out = tmp_path / "results" / "toy.json"
    judged = ("evaluate", "--controller", tmp_path / "toy.npz", "--episodes", 3, "--jobs", 1, "--out", out)
    code, said, err = processes.call(*judged, "--json")
    assert code == 0, err
    assert json.loads(said) == json.loads(out.read_text())
    recorded = read_evaluation_report(out)
    assert (recorded.controller, recorded.bundle) == (controller().sha256, random_bundle.sha256)
    assert (recorded.task, recorded.world, recorded.threshold) == (tasks.TOY, tasks.TOY, None)
    assert recorded.fingerprint == fingerprint(find_task(tasks.TOY).world.packages)
    assert [each.finished for each in recorded.drives] == [None] * 3
    code, said, err = call_here("verify", "report", out, "--episodes", 2, "--jobs", 1)
    assert (code, "2 bit-identical scores" in said) == (0, True), err
    out.write_text(replace(recorded, drives=(replace(recorded.drives[0], steps=9), *recorded.drives[1:])).to_json())
    code, said, err = call_here("verify", "report", out, "--jobs", 1, "--json")
    assert (code, json.loads(said)["reproduced"]) == (1, False), err
    out.write_text(replace(recorded, controller="ef" * 32).to_json())
    code, _, err = call_here("verify", "report", out)
    assert (code, "efefefefefef" in err) == (1, True)
    out.write_text(replace(recorded, bundle="ef" * 32).to_json())
    code, _, err = call_here("verify", "report", out)
    assert (code, "efefefefefef" in err) == (1, True)


def test_an_unwritable_report_is_an_error_before_the_first_episode(processes, controller, random_bundle, tmp_path):
    controller(tasks.HANGING).save(tmp_path / "toy.npz")
    judged = ("evaluate", "--controller", tmp_path / "toy.npz", "--bundle", random_bundle.path, "--out", tmp_path)
    code, _, err = call_here(*judged)
    assert (code, str(tmp_path) in err) == (2, True)
