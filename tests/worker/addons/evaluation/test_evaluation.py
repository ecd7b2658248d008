"""Tests evaluation.py, common/addons/evaluation_report.py, agents.py, predictor.py, verb.py,
worker/addons/verification/report_verb.py, dreamfleet/experiments/controllers.py and common/host/process_pool.py."""

import json
import os
import pickle
import re
import signal
import subprocess
import sys
from copy import deepcopy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import dreamfleet
from dreamfleet import make_environment, make_policy
from dreamfleet.common.addons.evaluation_report import (
    MAX_FIGURES,
    MAX_MARKS,
    SIGHTS,
    EvaluationReport,
    read_evaluation_report,
)
from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.artifacts.objective import Objective
from dreamfleet.common.errors import BundleError, ControllerError, DreamfleetError, UsageError
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.runs.episode_results import EpisodeResult, EpisodeResults
from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
from dreamfleet.worker.addons.evaluation import evaluation
from dreamfleet.worker.addons.evaluation.agents import make_agent
from dreamfleet.worker.addons.evaluation.evaluation import (
    AgentEvaluator,
    DriveStatistics,
    evaluate,
    evaluate_in_processes,
    judge,
)
from dreamfleet.worker.scoring import episode
from dreamfleet.worker.scoring.episode import EpisodeConfig, Transition
from dreamfleet.worker.tasks.api import Score, World
from dreamfleet.worker.tasks.registry import find_task
from tests.support import objectives, rough_tasks, tasks
from tests.support.processes import DEADLINE, call_here, environment
from tests.support.variants import controller_of

SEEDS = (10_000, 10_001, 10_002)
HALTING, POISONED, RAISING, WEARING = (
    rough_tasks.name_of(getattr(rough_tasks, name)) for name in ("Halting", "Poisoned", "Raising", "Wearing")
)


@pytest.fixture
def agent(random_bundle):
    return lambda task: make_agent(controller_of(random_bundle, task), random_bundle)


@pytest.fixture
def words(random_bundle, tmp_path):
    """The words that evaluate a controller of a task."""

    def of(task, *more):
        controller_of(random_bundle, task).save(tmp_path / "toy.npz")
        return "evaluate", "--controller", tmp_path / "toy.npz", "--bundle", random_bundle.path, *more

    return of


def test_scores_are_those_of_the_evaluation_environment(agent):
    judged, task = agent(tasks.JUDGED), find_task(tasks.JUDGED)
    environment, policy = task.make_evaluation_environment(None), task.make_policy(None)
    alone = {
        seed: episode.score(environment, policy, judged.parameters, EpisodeConfig(seed, 10**6)).fitness
        for seed in SEEDS
    }
    for jobs in (1, 2):
        drives = list(evaluate(judged, SEEDS, jobs))
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
def test_an_error_in_a_process_ends_the_evaluation_with_the_reason(agent, task, error, named):
    with pytest.raises(error, match=named):
        EpisodeResults.of(evaluate(agent(task), SEEDS, 2))


def test_a_functions_call_that_raises_is_a_failed_episode():
    options = Objective.of({"x0": [1.0, 2.0], "scale": 1.0, "minimise": True}).options
    task = f"function:{objectives.__name__}:brittle"
    controller = Controller(ControllerShape(0, 2), np.zeros(2, np.float32), task, "", options=options)
    found = EpisodeResults.of(evaluate(make_agent(controller), range(8), 1))
    assert ([each.seed for each in found.failed], len(found.drives)) == ([0, 4], 6)


@pytest.mark.slow
def test_an_episode_that_fails_is_reported_and_the_others_go_on(words, random_bundle, tmp_path):
    out = tmp_path / "toy.json"
    code, said, err = call_here(*words(tasks.BRITTLE, "--episodes", 30, "--jobs", 2, "--out", out))
    report, plain = read_evaluation_report(out), json.loads(out.read_text())
    failed = [each.seed for each in report.failed]
    assert (code, 0 < len(failed) < 30, len(report.drives) + len(failed)) == (0, True, 30), err
    assert f"seed {failed[0]}, ArithmeticError: the" in said
    assert all(f"seed {seed}, ArithmeticError: the world of" in err for seed in failed)
    assert plain["mean"] == pytest.approx(np.mean([each["score"] for each in plain["drives"]]))
    assert (plain["n"], [each["seed"] for each in plain["failed"]]) == (30 - len(failed), failed)
    code, said, err = call_here("verify", "report", out, "--bundle", random_bundle.path, "--jobs", 1, "--json")
    assert (code, json.loads(said)["reproduced"]) == (0, True), err


@pytest.mark.parametrize(
    ("task", "error"), [(tasks.NAN, "ValueError"), (RAISING, "KeyboardInterrupt"), (RAISING, "GeneratorExit")]
)
def test_an_evaluation_without_any_score_ends_with_one_line(words, monkeypatch, task, error):
    monkeypatch.setenv(rough_tasks.PLACE, "step")
    monkeypatch.setenv(rough_tasks.ERROR, error)
    code, out, err = call_here(*words(task, "--episodes", 2, "--jobs", 1))
    assert (code, out) == (1, ""), err
    assert f"seed 10000, {error}: " in err


@pytest.mark.slow
@pytest.mark.parametrize("poison", ["fail", "segfault"])
def test_an_episode_fails_only_in_a_fresh_process(agent, monkeypatch, poison):
    monkeypatch.setenv(rough_tasks.POISON, poison)
    alone, beside = (
        EpisodeResults.of(evaluate_in_processes(agent(POISONED), tuple(range(4)), jobs)) for jobs in (1, 2)
    )
    assert (len(alone.drives), alone.failed) == (4, ())
    assert sorted(alone.drives, key=lambda each: each.seed) == sorted(beside.drives, key=lambda each: each.seed)


def test_in_the_own_process_an_episode_fails_only_in_a_fresh_environment(agent):
    assert len(EpisodeResults.of(evaluate(agent(WEARING), tuple(range(4)), 1)).drives) == 4


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_an_episode_that_crashes_or_hangs_is_given_up_and_the_others_go_on(agent, monkeypatch, jobs):
    monkeypatch.setenv(rough_tasks.EXIT, "0")
    monkeypatch.setenv(rough_tasks.HALT, "5")
    found = EpisodeResults.of(evaluate_in_processes(agent(HALTING), tuple(range(8)), jobs, stall=2.0))
    crashed, hung = sorted(found.failed, key=lambda each: each.seed)
    assert (crashed.seed, "exit status 3" in crashed.error, hung.seed) == (0, True, 5)
    assert len(found.drives) == 6


def test_an_interrupted_evaluation_says_what_it_has(processes, words, monkeypatch):
    monkeypatch.setenv(rough_tasks.EXIT, "10003")
    monkeypatch.setenv(rough_tasks.HALT, "10004")
    evaluation = processes.start(*words(HALTING, "--episodes", 5, "--jobs", 1), "--trust", rough_tasks.MODULE)
    evaluation.wait_for("seed 10003")
    os.killpg(evaluation.popen.pid, signal.SIGINT)  # as a terminal does
    assert evaluation.finish()[0] == 130
    assert re.search(r"\b3 .*\b5 .*-\d.*±", evaluation.last_line()), evaluation.last_line()


def test_a_world_model_that_fits_is_found_beside_its_controller_or_by_name(random_bundle):
    controller = controller_of(random_bundle)
    for named in ((str(random_bundle.path),), (None, random_bundle.path)):
        assert find_bundle_of(controller, *named).sha256 == random_bundle.sha256
    with pytest.raises(BundleError):
        find_bundle_of(replace(controller, bundle="ab" * 32), None, random_bundle.path)
    with pytest.raises(BundleError, match="--bundle"):
        find_bundle_of(controller, None)
    small = Controller(ControllerShape(4, 3), np.zeros(15, np.float32), "car-racing", "ab" * 32)
    with pytest.raises(ControllerError, match="15"):
        find_bundle_of(small, str(random_bundle.path))


@pytest.mark.slow
def test_the_report_is_what_it_prints_and_can_be_repeated_to_the_bit(random_bundle, tmp_path):
    controller = controller_of(random_bundle, tasks.TOY)
    controller.save(tmp_path / "toy.npz")
    (tmp_path / "bundle.zip").write_bytes(random_bundle.path.read_bytes())
    out, flags = tmp_path / "results" / "toy.json", ("--first-seed", 9_999, "--episodes", 3, "--jobs", 1, "--json")
    code, said, err = call_here("evaluate", "--controller", tmp_path / "toy.npz", "--out", out, *flags)
    assert (code, "19999" in err) == (0, True), "the first seed is none of the test set's"
    printed, recorded = json.loads(said), read_evaluation_report(out)
    assert printed == json.loads(out.read_text())
    assert (printed["seeds"], printed["mean"]) == ([9_999, 10_000, 10_001], pytest.approx(np.mean(printed["scores"])))
    assert (recorded.controller, recorded.bundle) == (controller.sha256, random_bundle.sha256)
    assert (recorded.task, recorded.world, recorded.threshold) == (tasks.TOY, tasks.TOY, None)
    assert recorded.fingerprint == fingerprint(find_task(tasks.TOY).world.packages)
    assert [each.finished for each in recorded.drives] == [None] * 3

    def verified(report, *more):
        out.write_text(report.to_json())
        code, said, err = call_here("verify", "report", out, "--jobs", 1, "--json", *more)
        return code, said and json.loads(said)["reproduced"], err

    assert verified(recorded, "--episodes", 2)[:2] == (0, True)
    first, *others = recorded.drives
    assert verified(replace(recorded, drives=(replace(first, steps=9), *others)))[:2] == (1, False)
    for other in (replace(recorded, controller="ef" * 32), replace(recorded, bundle="ef" * 32)):
        code, _, err = verified(other)
        assert (code, "efefefefefef" in err) == (1, True)


def test_blind_episodes_stand_beside_those_with_sight(words, tmp_path):
    out, flags = tmp_path / "report.json", ("--episodes", 3, "--jobs", 1, "--json")
    code, said, err = call_here(*words(tasks.MASKED, *flags))
    assert code == 0, err
    plain = json.loads(said)
    code, said, err = call_here(*words(tasks.MASKED, *flags, "--blind", "--out", out))
    assert code == 0, err
    found, recorded = json.loads(said), read_evaluation_report(out)
    assert (code, found["scores"]) == (0, plain["scores"])
    assert (found["hidden_loss"], found["foreign_loss"]) == (pytest.approx(10), pytest.approx(20))
    assert (found["hidden_mean"], found["foreign_mean"]) == (
        pytest.approx(plain["mean"] - 10), pytest.approx(plain["mean"] - 20)
    )  # fmt: skip
    assert [each.seed for each in recorded.foreign] == found["seeds"]
    assert "20" in recorded.describe().splitlines()[2]
    code, _, err = call_here(*words(tasks.TOY, *flags, "--blind"))
    assert (code, "--blind" in err) == (2, True)


@pytest.mark.parametrize(("asked", "sees"), [(9, True), (15, False)])
def test_a_loss_that_is_asked_of_blind_episodes_decides_the_exit_code(words, tmp_path, asked, sees):
    """Hidden costs 10, another's sight 20."""
    out = tmp_path / "report.json"
    code, said, err = call_here(*words(tasks.MASKED, "--episodes", 2, "--jobs", 1, "--out", out, "--blind", asked))
    report, plain = read_evaluation_report(out), json.loads(out.read_text())
    assert (code, report.sees, plain["sees"]) == (0 if sees else 1, sees, sees), err
    assert (report.asked_loss, plain["asked_loss"]) == (asked, asked)
    assert report.describe_sight() in said


@pytest.mark.parametrize("asked", ["-1", "nan", "1e101"])
def test_a_loss_that_cannot_be_asked_for_is_refused_before_the_episodes(words, asked):
    code, _, err = call_here(*words(tasks.HANGING, "--blind", asked))
    assert (code, "--blind" in err) == (2, True)


def test_a_world_with_more_figures_or_marks_than_a_report_holds_is_refused_before_the_episodes():
    for most, name in ((MAX_FIGURES, "figures"), (MAX_MARKS, "marks")):
        agent = SimpleNamespace(world=World(STEERING_GAS_BRAKE, **{name: tuple(range(most + 1))}))
        with pytest.raises(UsageError, match=str(most)):
            judge("a", agent, SEEDS, 1)


def test_blind_episodes_that_fail_are_kept_and_all_passes_have_the_same_seeds(words, random_bundle, tmp_path):
    out = tmp_path / "report.json"
    code, said, err = call_here(*words(tasks.VEILED, "--episodes", 4, "--jobs", 1, "--blind", "--out", out))
    assert code == 0, err
    assert all(re.search(rf"^{how} .*4/4", err, re.MULTILINE) for how in SIGHTS.values()), err
    report = read_evaluation_report(out)
    assert [each.seed for each in report.hidden_failed + report.foreign_failed] == [10_001, 10_002]
    assert (len(report.drives), len(report.hidden), len(report.foreign)) == (4, 3, 3)
    figures, plain = report.figures, {each.seed: each.score for each in report.drives}
    both = [plain[10_000], plain[10_003]]
    assert (figures["hidden_n"], figures["foreign_n"]) == (2, 2)
    assert (figures["hidden_mean"], figures["hidden_loss"]) == (pytest.approx(np.mean(both) - 10), pytest.approx(10))
    assert figures["foreign_mean"] == pytest.approx(np.mean(both) - 20)
    hidden, foreign = (each.splitlines()[0] for each in report.describe().split("\n")[1:3])
    assert re.search(r" 2 .*10001", hidden)
    assert re.search(r" 2 .*10002", foreign)
    code, said, err = call_here("verify", "report", out, "--bundle", random_bundle.path, "--jobs", 1, "--json")
    assert (code, json.loads(said)["reproduced"]) == (0, True), err
    assert len(json.loads(said)["reports"][0]["blind"]) == 2


def test_a_blind_pass_that_cannot_be_driven_takes_nothing_from_those_before(words, tmp_path):
    out, flags = tmp_path / "report.json", ("--episodes", 2, "--jobs", 1, "--blind", "--json")
    code, said, err = call_here(*words(tasks.HALF_MASKED, *flags, "--out", out))
    report = read_evaluation_report(out)
    assert (code, SIGHTS["foreign"] in err, json.loads(said)["n"]) == (2, True, 2)
    assert (len(report.drives), len(report.hidden), report.foreign) == (2, 2, ())
    assert (report.figures["hidden_n"], report.figures["foreign_n"]) == (2, None)


@pytest.mark.parametrize(("send", "number"), [(os.killpg, signal.SIGINT), (os.kill, signal.SIGTERM)])
def test_an_interrupted_blind_pass_takes_nothing_from_those_before(
    processes, words, monkeypatch, tmp_path, send, number
):
    monkeypatch.setenv(rough_tasks.EXIT, "10001")
    monkeypatch.setenv(rough_tasks.HALT, "10002")
    out, flags = tmp_path / "report.json", ("--episodes", 4, "--jobs", 1, "--blind", "--trust", rough_tasks.MODULE)
    task = rough_tasks.name_of(rough_tasks.HaltingWithOthersSight)
    evaluation = processes.start(*words(task, *flags, "--out", out))
    evaluation.wait_for("seed 10001")
    send(evaluation.popen.pid, number)
    assert evaluation.finish()[0] == 130
    report = read_evaluation_report(out)
    assert (len(report.drives), len(report.hidden), report.foreign) == (4, 4, ())


def test_blind_drives_are_driven_again_and_a_forged_one_is_found(words, random_bundle, tmp_path):
    out = tmp_path / "report.json"
    code, _, err = call_here(*words(tasks.MASKED, "--episodes", 3, "--jobs", 1, "--blind", "--out", out))
    assert code == 0, err
    recorded = read_evaluation_report(out)

    def verified(report):
        out.write_text(report.to_json())
        code, said, _ = call_here("verify", "report", out, "--bundle", random_bundle.path, "--jobs", 1, "--json")
        row = json.loads(said)["reports"][0] if said else {"blind": [], "sees": None}
        return code, [each["differing"] for each in row["blind"]], row["sees"]

    assert verified(replace(recorded, asked_loss=15.0)) == (0, [[], []], False), "as it was recorded"
    first, *others = recorded.foreign
    forged = replace(recorded, foreign=(replace(first, score=first.score - 1), *others))
    assert verified(forged) == (1, [[], [first.seed]], None)
    lower = zip(recorded.hidden, (0.1, 0.12, -0.02), strict=True)  # within two standard errors of the true ones
    forged = replace(recorded, hidden=tuple(replace(each, score=each.score - less) for each, less in lower))
    forged = replace(forged, fingerprint="elsewhere", asked_loss=10.05)
    assert forged.sees
    assert verified(forged) == (1, [[*forged.results.seeds], []], False)
    assert verified(replace(forged, asked_loss=9.0)) == (0, [[*forged.results.seeds], []], True)
    assert verified(replace(recorded, hidden=(), foreign=())) == (0, [], None)
    controller_of(random_bundle, tasks.TOY).save(tmp_path / "toy.npz")
    code, _, _ = call_here(*words(tasks.TOY, "--episodes", 3, "--jobs", 1, "--out", out))
    assert (code, verified(replace(read_evaluation_report(out), hidden=recorded.hidden))[0]) == (0, 2)


def test_an_unwritable_report_is_an_error_before_the_first_episode(words, tmp_path):
    code, _, err = call_here(*words(tasks.HANGING, "--out", tmp_path))
    assert (code, str(tmp_path) in err) == (2, True)


@pytest.mark.parametrize("task", ["car-racing", "dream"])
def test_it_reports_speed_and_brake_of_a_drive_that_is_the_same_unwatched(monkeypatch, tmp_path, task):
    monkeypatch.setattr(evaluation, "EpisodeConfig", lambda seed, _horizon: EpisodeConfig(seed, 12))
    controller = find_controller("tiny", tmp_path)[0]
    parameters = controller.parameters.copy()
    parameters[2 * 288 : 3 * 288], parameters[-1] = 0.0, 5.0  # the brake's weights and bias: it is always on
    agent = make_agent(replace(controller, parameters=parameters, task=task), find_bundle("tiny"))
    judge, unwatched = AgentEvaluator(agent), agent.make_evaluation_environment()
    drive = judge.drive(SEEDS[0])
    alone = episode.score(unwatched, agent.make_policies()(SEEDS[0]), parameters, EpisodeConfig(SEEDS[0], 12))
    judge.close()
    unwatched.close()
    assert (drive.seed, drive.score, drive.steps) == (SEEDS[0], alone.fitness, 12)
    assert (drive.finished, drive.braking) == (False, 1.0)
    assert 0 <= drive.speed < 20


def moment(info):
    return Transition(None, np.zeros(3), 1.0, 1, bool(info), False, info)


def test_a_world_without_a_true_state_has_no_statistics():
    watch = DriveStatistics(World(STEERING_GAS_BRAKE, action_names=("steer", "gas", "brake")), None)
    watch.on_transition(moment({"lap_finished": True}))
    assert watch.drive(3, Score(5.0, 1)) == EpisodeResult(3, 5.0, 1)


def test_what_a_world_says_of_an_episode_at_its_end_is_reported_as_a_mean():
    drives = []
    for seed, infos in ((1, ({"turns": 9}, {"turns": 2, "other": 1})), (2, ({},)), (3, ({"turns": 3},))):
        watch = DriveStatistics(replace(find_task("car-racing").world, figures=("turns",)), None)
        for info in infos:
            watch.on_transition(moment(info))
        drives.append(watch.drive(seed, Score(5.0, 1)))
    assert [each.figures for each in drives] == [{"turns": 2.0}, None, {"turns": 3.0}]
    report = EvaluationReport("a", "ab", "a", "a", "", "", "", 1.0, tuple(drives))
    assert report.figures["figures"] == {"turns": 2.5}
    assert "2.5" in report.describe()


@pytest.mark.parametrize("said", [np.nan, np.inf, 1e200, 10**400, None, "a", np.zeros(2), [1]])
def test_what_is_no_number_of_a_report_is_left_out_and_costs_no_score(said):
    watch = DriveStatistics(replace(find_task("car-racing").world, figures=("turns", "hits")), None)
    watch.on_transition(moment({"turns": said, "hits": np.float32(2)}))
    assert watch.drive(1, Score(5.0, 1)).figures == {"hits": 2.0}


def test_a_worlds_figure_may_have_any_name(tmp_path):
    figures = {"name": 1.0, "mean": 3.0, "above_water": 4.0, "hidden_loss": 5.0, "seeds": 6.0}
    report = EvaluationReport("a", "ab", "a", "a", "", "", "", 1.0, (EpisodeResult(1, 5.0, 1, figures=figures),))
    (tmp_path / "report.json").write_text(report.to_json())
    assert read_evaluation_report(tmp_path / "report.json") == report
    plain = json.loads(report.to_json())
    assert (plain["mean"], plain["hidden_loss"], plain["seeds"], plain["figures"]) == (5.0, None, [1], figures)


@pytest.mark.parametrize(
    ("last", "finished"), [({"lap_finished": True}, True), ({"lap_finished": False}, False), ({}, False)]
)
def test_a_lap_is_finished_if_the_environment_says_so_at_the_end(last, finished):
    watch = DriveStatistics(find_task("car-racing").world, lambda: {"speed": 30.0})
    for info in ({}, last):
        watch.on_transition(moment(info))
    drive = watch.drive(1, Score(900.0, 2))
    assert (drive.finished, drive.speed, drive.braking) == (finished, 30.0, 0.0)


POLE = Controller(ControllerShape(4, 2), np.arange(10, dtype=np.float32), "gym:CartPole-v1", "")
PICTURES = np.random.default_rng(1).integers(0, 256, (6, 64, 64, 3), dtype=np.uint8)


def test_it_acts_as_the_policy_does_in_an_episode():
    controller = dreamfleet.find_controller("tiny")
    policy, drive = make_policy(controller), make_environment(controller)
    observation, _ = drive.reset(seed=5)
    state = reward = None
    for _ in range(12):
        action, state = controller.predict(observation, state, reward=reward)
        assert np.array_equal(action, policy.act(observation))
        observation, reward, *_ = drive.step(action)
        policy.reward(reward)
    drive.close()


def test_a_state_is_a_value_that_can_be_used_again():
    controller = dreamfleet.find_controller("tiny")
    states, actions = [None], []
    for picture in PICTURES:
        action, state = controller.predict(picture, states[-1])
        states.append(state)
        actions.append(action)
    for number in (4, 1, 0, 5):  # in any order
        kept = deepcopy(states[number])
        action, state = controller.predict(PICTURES[number], kept)
        assert np.array_equal(action, actions[number])
        assert np.array_equal(state, states[number + 1])
        assert number == 0 or np.array_equal(kept, states[number])
    begun, _ = controller.predict(PICTURES[0], states[4], episode_start=True)
    assert np.array_equal(begun, actions[0])


def test_without_a_world_model_it_has_no_state_and_it_can_be_copied_and_pickled_afterwards():
    assert POLE.predict(np.array([1, 0, 0, 0]), deterministic=True) == (1, None)
    for other in (pickle.loads(pickle.dumps(POLE)), deepcopy(POLE)):
        assert other.predict(np.ones(4)) == POLE.predict(np.ones(4))


def test_the_state_of_another_controller_is_refused():
    with pytest.raises(ControllerError, match=r"\(3,\) .*\(1, 512\)"):
        dreamfleet.find_controller("tiny").predict(PICTURES[0], np.zeros(3))
    with pytest.raises(ControllerError):
        POLE.predict(np.ones(4), np.zeros((1, 512)))


def test_its_world_model_may_be_given(random_bundle):
    controller = controller_of(random_bundle)
    with pytest.raises(BundleError):
        controller.predict(PICTURES[0])
    action, _ = controller.predict(PICTURES[0], bundle=random_bundle)
    assert action.shape == (3,)


def test_without_the_packages_of_a_worker_the_error_names_what_to_install(tmp_path):
    POLE.save(tmp_path / "pole.npz")
    program = (
        "import sys; sys.modules['gymnasium'] = None\n"
        "from pathlib import Path; from dreamfleet import Controller\n"
        f"Controller.load(Path({str(tmp_path / 'pole.npz')!r})).predict([0, 0, 0, 0])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment(tmp_path), capture_output=True, text=True, check=False,
        timeout=DEADLINE,
    )  # fmt: skip
    assert "'dreamfleet[worker]'" in done.stderr
