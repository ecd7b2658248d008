"""Searching a function's minimum on processes of this host.
Tests dreamfleet/experiments/local/search_arguments.py and worker/worlds/function/task.py."""

import re
from contextlib import suppress

import numpy as np
import pytest

import dreamfleet
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import StoppedError, UsageError
from dreamfleet.common.protocol.stop_kind import StopKind
from dreamfleet.coordinator.run.recall import bar_stored
from dreamfleet.experiments import minimise as module
from dreamfleet.experiments.local.search_arguments import limits_within, read_bounds, read_objective
from tests.support import lying_tasks, objectives
from tests.support.lying_tasks import LIES
from tests.support.processes import free_port, until

FEW = {"workers": 1, "popsize": 8}
CALLED_OTHERWISE = {
    "budget": "maxfevals", "maxiter": "generations", "maxfeval": "maxfevals", "call_back": "callback",
    "sigma": "sigma0", "n_jobs": "workers", "tol": "ftarget",
}  # fmt: skip


def stop_kind(found, runs_dir):
    with dreamfleet.open_run(found.run, runs_dir) as run:
        return run.stop_kind


@pytest.mark.slow
def test_it_finds_the_minimum_and_the_run_can_be_read(tmp_path):
    seen = []
    found = dreamfleet.minimise(
        objectives.sphere, [0, 3], 0.5, bounds=[(None, 5), (0, 4)], ftarget=1e-6, callback=seen.append,
        run="mine", runs_dir=tmp_path, **FEW,
    )  # fmt: skip
    assert found.success
    assert found.fun == objectives.sphere(found.x) <= 1e-6
    assert found.history == tuple(seen)
    assert [each.fun for each in seen] == sorted((each.fun for each in seen), reverse=True)
    with dreamfleet.open_run(found.run, tmp_path) as run:
        assert found.nfev == run.result_count() >= 8 * found.nit
        assert -run.history()[-1].best == objectives.sphere(found.xbest) >= found.fun
        assert run.spec.horizon == 1
        assert run.stop_kind is StopKind.CANDIDATE_TARGET


@pytest.mark.slow
def test_a_noisy_search_gives_the_mean_that_was_judged_and_has_no_more_calls_than_maxfevals(tmp_path):
    found = dreamfleet.minimise(objectives.noisy, [1, 1], 0.3, maxfevals=400, run="mine", runs_dir=tmp_path, **FEW)
    assert np.array_equal(found.x, found.xfavorite)
    assert not np.array_equal(found.x, found.xbest)
    assert not found.success
    assert "maxfevals=400" in found.message
    with dreamfleet.open_run("mine", tmp_path) as run:
        assert run.stop_kind is StopKind.GENERATIONS
        generation = run.settings.population * run.settings.episodes
        assert len(run.evaluations()) > 1
        assert run.confirmation() is not None
        assert 400 - 2 * generation - run.settings.evaluation_episodes < found.nfev == run.result_count() <= 400


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*holed .*nan:RuntimeWarning")
@pytest.mark.parametrize(
    ("function", "budget", "least", "given"),
    [
        (objectives.noisy, 150, 130, {"popsize": 6, "episodes": 4, "racing": True}),
        (objectives.holed, 60, 20, {"popsize": 6, "evaluate_every": 1}),
        (objectives.sphere, 50, 50, {"popsize": 7}),
        (objectives.noisy, 40, 36, {"popsize": 6}),
    ],
)
def test_races_failures_and_a_budget_without_a_mean_keep_to_maxfevals(function, budget, least, given, tmp_path):
    found = dreamfleet.minimise(function, [1.1, 1], 0.3, maxfevals=budget, runs_dir=tmp_path, **{**FEW, **given})
    assert least <= found.nfev <= budget


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "success", "function", "given"),
    [
        (StopKind.ONE_POINT, True, objectives.sphere, {"stagnation": 0, "popsize": 16}),
        (StopKind.ONE_POINT, False, objectives.sphere, {"stagnation": 0, "popsize": 16, "ftarget": -1.0}),
        (StopKind.STAGNATION, True, objectives.flat, {"stagnation": 2}),
        (StopKind.TARGET, True, objectives.noisy, {"ftarget": 100.0, "evaluate_every": 1, "confirm_episodes": 0}),
    ],
)
def test_a_search_succeeds_where_it_converged_or_reached_its_target(kind, success, function, given, tmp_path):
    found = dreamfleet.minimise(function, [1.5, 2], 0.1, runs_dir=tmp_path, **{**FEW, **given})
    assert found.success is success
    assert stop_kind(found, tmp_path) is kind
    assert "--" not in found.message, "it is read in a program"


@pytest.mark.slow
def test_a_search_that_somebody_stops_raises(tmp_path):
    address = f"tcp/127.0.0.1:{free_port()}"

    def stop(progress):
        if progress.generation == 0:
            with Client(address) as client:
                client.control(progress.run, "stop")

    with pytest.raises(StoppedError):
        dreamfleet.minimise(objectives.flat, [0, 0], 1.0, callback=stop, listen=address, runs_dir=tmp_path, **FEW)


@pytest.mark.slow
def test_what_a_barred_host_brought_is_in_no_result(processes, tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    task = ("--task", "function:tests.support.lying_tasks:sphere")
    liar = processes.worker("--run", "mine", "--name", "liar", *task, endpoint=endpoint, inside=("env", f"{LIES}=1"))
    seen = []

    def bar_a_liar(progress):
        seen.append(progress)
        if progress.fun < 0 and min((each.fun for each in seen[:-1]), default=0) >= 0:
            with Client(endpoint) as client:
                client.control("mine", "bar", "liar")

    found = dreamfleet.minimise(
        lying_tasks.sphere, [3, 4], 1.0, generations=20, run="mine", runs_dir=tmp_path, listen=endpoint,
        callback=bar_a_liar, **FEW,
    )  # fmt: skip
    liar.end()
    assert min(each.fun for each in seen) < 0
    assert found.fun == pytest.approx(lying_tasks.sphere(found.x))
    with dreamfleet.open_run("mine", tmp_path) as run:
        assert [each.mean for each in found.history] == [-each.mean for each in run.history()]
        assert found.history[-1].fun == -max(each.best for each in run.history())


@pytest.mark.slow
def test_what_is_recalled_after_the_end_is_in_no_result(tmp_path):
    barred = []

    def bar(progress):
        def is_barred():
            with suppress(UsageError):  # while it is served
                bar_stored(tmp_path / progress.run, "core-0", is_barred=True)
                return True
            return False

        if progress.generation == 0:
            with dreamfleet.open_run(progress.run, tmp_path) as run:
                until(lambda: run.ended is not None, "the run ends")
            until(is_barred, "the only host is barred")
            barred.append(progress.run)

    with pytest.raises(UsageError):
        dreamfleet.minimise(objectives.sphere, [0, 0], 1.0, generations=3, callback=bar, runs_dir=tmp_path, **FEW)
    assert len(barred) == 1


@pytest.mark.slow
def test_restarts_are_runs_of_larger_populations_and_share_the_budget_while_a_generation_fits_in(tmp_path):
    given = {"bounds": (-2, 2), "maxfevals": 90, "restarts": 3, "generations": 2, **FEW}
    found = dreamfleet.maximise(objectives.sphere, [0, 0], 1.0, run="mine", runs_dir=tmp_path, **given)
    assert found.runs == ("mine", "mine-restart-1", "mine-restart-2")
    sizes = []
    for name in found.runs:
        with dreamfleet.open_run(name, tmp_path) as run:
            sizes.append((run.settings.population, len(run.history())))
    assert sizes == [(8, 2), (16, 2), (32, 1)]
    assert found.nfev <= 90
    assert found.fun == max(each.fun for each in found.history) > 2


@pytest.mark.slow
def test_a_function_that_varies_without_a_seed_is_warned_of_whatever_the_log_looks_like(tmp_path, monkeypatch):
    monkeypatch.setenv("DREAMFLEET_LOG_FORMAT", "json")
    with pytest.warns(RuntimeWarning, match="varying") as warned:
        dreamfleet.minimise(objectives.varying, [0, 0], 1.0, generations=1, runs_dir=tmp_path, **FEW)
    assert {each.filename for each in warned} == {__file__}


@pytest.mark.slow
def test_failed_candidates_are_tried_in_a_fresh_process_and_said_once(tmp_path):
    with pytest.warns(RuntimeWarning, match="holed .*nan") as warned:
        found = dreamfleet.minimise(objectives.holed, [1, 1], 1.0, generations=4, run="mine", runs_dir=tmp_path, **FEW)
    assert [each.filename for each in warned] == [__file__]
    with dreamfleet.open_run("mine", tmp_path) as run:
        failed, failures = sum(each.failed for each in run.history()), run.failures()
    assert len(failures) == failed > 1
    assert {each.attempts for each in failures} == {2}  # what a process did before may be the reason
    for text in (found.message, (tmp_path / "mine" / "coordinator.log").read_text()):
        assert re.search(rf"\b{failed} .*holed .*nan", text)


@pytest.mark.slow
def test_a_search_without_any_value_ends_with_its_first_failure(tmp_path):
    with pytest.raises(UsageError, match=r"narrow .*ZeroDivisionError"):
        dreamfleet.minimise(objectives.narrow, [0, 0], 30.0, runs_dir=tmp_path, **FEW)


@pytest.mark.slow
def test_a_search_that_loses_all_values_returns_what_it_found(tmp_path, monkeypatch):
    lost, few = tmp_path / "lost", {"workers": 1, "popsize": 4, "runs_dir": tmp_path / "runs"}
    monkeypatch.setenv("LOST", str(lost))
    with pytest.warns(RuntimeWarning, match="losing .*nan"):
        found = dreamfleet.minimise(objectives.losing, [0, 0], 1.0, callback=lambda _: lost.touch(), **few)
    # On a busy host several generations close before the first call, and a mean that is evaluated may be better.
    assert found.fun <= found.history[-1].fun
    assert not found.success
    assert stop_kind(found, tmp_path / "runs") is None, "it was left open"


@pytest.mark.slow
def test_a_callback_ends_the_search_and_all_numbers_are_of_one_moment(tmp_path):
    seen = []

    def stop(progress):
        seen.append(progress)
        with dreamfleet.open_run(progress.run, tmp_path) as run:
            if progress.generation == 1:
                until(lambda: len(run.history()) >= 4, "the search goes on meanwhile")
                raise StopIteration

    found = dreamfleet.minimise(objectives.sphere, [0, 0], 1.0, callback=stop, restarts=2, runs_dir=tmp_path, **FEW)
    assert (len(found.runs), found.success) == (1, False)
    assert found.history[:2] == tuple(seen)
    with dreamfleet.open_run(found.run, tmp_path) as run:
        assert (run.stop_kind, run.state) == (None, "open"), "it was left open"
        history = run.history()
        assert found.nit == len(found.history) == len(history) >= 4
        assert found.history[-1].nfev == sum(each.steps for each in history)
        assert found.nfev == run.result_count()
        assert objectives.sphere(found.xbest) == -max(each.best for each in history)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"bounds": [(0, 1)]}, "2 parameters"),
        ({"bounds": (3, 4)}, "3.* 4"),
        ({"restart": "cma"}, "cma"),
        ({"sigma0": 0}, " 0"),
        ({"sigma0": None}, " 0"),
        ({"bounds": (0.2, 0.8), "x0": [0.5, 0.5], "integer": True}, "0.2 .*0.8"),
        ({"nothing": 3}, "'nothing'"),
        ({"args": (3,)}, r"functools\.partial"),
        ({"bounds": [(0, 0), (0, 0)]}, "."),
        ({"disp": True}, "`callback=print`"),
        ({"seed": "x"}, "'x'"),
        ({"generations": "x"}, "'x'"),
        ({"seed": -1}, "-1"),
        ({"seed": 2**63 - 1}, str(2**63 - 1)),
        ({"function": objectives.raising}, "raising.* ZeroDivisionError"),
        ({"function": "tests.support.objectives:nowhere"}, "nowhere"),
        *(({wrong: 3}, f"'{wrong}'.* '{right}'") for wrong, right in CALLED_OTHERWISE.items()),
    ],
)
def test_what_cannot_be_searched_is_refused_before_a_run_exists(change, named, tmp_path):
    given = {"function": objectives.sphere, "x0": [0, 0], "sigma0": 1.0, "runs_dir": tmp_path, **FEW, **change}
    with pytest.raises(UsageError, match=named):
        dreamfleet.minimise(given.pop("function"), given.pop("x0"), given.pop("sigma0"), **given)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("calls", "is_first", "given", "limits"),
    [
        (5, True, {}, {"generations": 1, "evaluate_every": 0, "target": None}),
        (51, True, {}, {"generations": 4, "evaluate_every": 0, "target": None}),
        (5, False, {}, {"generations": 1}),
        (52, True, {}, {"generations": 1}),
        (400, True, {"generations": 2}, {"generations": 2}),
    ],
)
def test_a_budget_below_one_generation_has_one_and_no_mean(calls, is_first, given, limits):
    noisy = {"population": 6, "target": -1.0, **module.NOISY, **given}
    assert limits_within(calls, noisy, is_first=is_first) == {"steps": calls, **limits}


def test_the_first_step_is_a_share_of_the_range_where_bounds_are_finite():
    given = {"integer": (), "log": [1]}
    found = read_objective([1, 1], None, [(0, 10), (np.exp(-1), np.exp(1))], given)
    assert found.scale == pytest.approx((3.0, 0.6))
    with pytest.raises(UsageError, match="1"):
        read_objective([1, 1], None, [(0, 10), (0, None)], given)


def test_bounds_are_scipys_or_one_pair():
    class Bounds:
        lb, ub = np.array([0.0, -np.inf]), np.array([1.0, 2.0])

    assert read_bounds(Bounds(), 2) == ([0.0, None], [1.0, 2.0])
    assert read_bounds((0, None), 2) == ([0.0, 0.0], [None, None])
    assert read_bounds([(0, 1), (2, 3)], 2) == ([0.0, 2.0], [1.0, 3.0])
    assert read_bounds(None, 2) == (None, None)


def test_bipop_alternates_large_populations_and_small_ones_of_as_many_calls():
    given = {"integer": (), "log": ()}
    searches = module._Searches(objectives.sphere, [0.0], 1.0, None, given, None, None, None, 1, None, {})
    plans = []
    for plan in searches._plans(8, 1, 6, "bipop"):
        plans.append(plan)
        searches._calls += plan.popsize * 10 if not plan.calls else min(plan.calls, plan.popsize * 10)
    assert [each.popsize for each in plans[:2]] == [8, 16]
    assert len({each.seed for each in plans}) == 7
    small = [each for each in plans if each.calls]
    assert small
    assert all(each.sigma < 1 for each in small)
