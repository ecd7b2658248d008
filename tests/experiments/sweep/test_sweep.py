"""A sweep's plan, what it keeps, and its results, without processes.
Tests figure.py, folder.py, plan.py, summary.py, dreamfleet/experiments/local/kept_words.py and
dreamfleet/experiments/verbs/sweep.py."""

import argparse
import json
import re
import sys
from dataclasses import replace

import pytest

from dreamfleet.common.artifacts.objective import Objective
from dreamfleet.common.cli.command_line import build_parser
from dreamfleet.common.cli.global_config import complete_arguments
from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.host.trusted_modules import VARIABLE
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.experiments.local.local_run import task_flags
from dreamfleet.experiments.sweep import runner, summary
from dreamfleet.experiments.sweep.figure import sweep_figure
from dreamfleet.experiments.sweep.folder import SETTINGS, StoredSweep, SweepFolder
from dreamfleet.experiments.sweep.plan import MOST_RUNS, Sweep, SweepOptions, parse_vary, read_vary
from dreamfleet.experiments.sweep.summary import CONFIRMED, FITNESS, CurvePoint, RunResult, find_equal, judged_by
from dreamfleet.experiments.verbs import sweep as sweep_verb
from dreamfleet.experiments.verbs.sweep import check_runs
from dreamfleet.worker.verbs import worker

SOURCES = {"flags": argparse.Namespace(), "environment": {}, "file": {}}
FLAGS = ("--task=gym:CartPole-v1", "--generations=2")


@pytest.fixture
def folder(tmp_path):
    found = SweepFolder(tmp_path, "carts")
    found.path.mkdir()
    return found


def sweep_of(*vary, flags=FLAGS, name="carts"):
    return Sweep(name, parse_vary(vary), flags)


def test_progress_of_a_minimised_function_has_its_value():
    options = Objective.of({"dimension": 2, "x0": 0, "minimise": True}).options
    task = to_plain(TaskSpec("function:mine:cost", "", 1, 0, options=options))
    status = {"state": "running", "generations": 2, "limits": {}, "best": {"mean": -0.25}, "settings": {"task": task}}
    assert re.findall(r"-?0\.25", runner.describe(status)) == ["0.25"]
    status["settings"]["task"] = to_plain(TaskSpec("gym:CartPole-v1", "", 9, 0))
    assert re.findall(r"-?0\.25", runner.describe(status)) == ["-0.25"]
    assert runner.describe({}) == ""


def test_a_grid_has_every_combination_and_repeats_all_settings_before_the_next_seed():
    sweep = sweep_of("sigma0=0.05,0.1", "seed=1..3")
    assert [each.name for each in sweep.runs][:3] == [
        "carts-sigma0-0-05-seed1", "carts-sigma0-0-1-seed1", "carts-sigma0-0-05-seed2",
    ]  # fmt: skip
    assert len(sweep.runs) == 6
    assert {each.setting for each in sweep.runs} == {"sigma0 0.05", "sigma0 0.1"}
    assert sweep.runs[0].flags == ("--sigma0=0.05", "--seed=1")
    assert {each.setting for each in sweep_of("seed=1..3").runs} == {"all equal"}
    assert [each.flags for each in sweep_of("racing=true,false").runs] == [("--racing",), ("--no-racing",)]
    assert len(sweep_of(f"seed=1..{MOST_RUNS}").runs) == MOST_RUNS
    assert read_vary({"seed": "1..2", "hidden_units": [4, 8]}) == {"seed": ("1", "2"), "hidden-units": ("4", "8")}


@pytest.mark.parametrize(
    "vary",
    [
        [], ["seed"], ["seed="], ["seed=1,,2"], ["seed=1-5"], ["seed=5..1"], ["seed=1..1000000000000"],
        ["seed=1..100", "horizon=1..100"], ["seed=1,1"], ["seed=1", "seed=2"], ["sigma0=0.05,0-05"],
        ["sigma0=" + "1" * 80],
    ],
)  # fmt: skip
def test_what_makes_no_sweep_is_refused(vary):
    with pytest.raises(UsageError):
        sweep_of(*vary)


@pytest.mark.parametrize(
    ("vary", "flags", "named"),
    [
        (["sigma0=0.1,-1"], FLAGS, "carts-sigma0-1 .*--sigma0"),
        (["population=many"], FLAGS, "--population"),
        (["bogus=1"], FLAGS, "bogus"),
        (["optimiser=cma,nobodys"], FLAGS, "'nobodys'"),
        (["seed=1..2"], FLAGS[:1], "--generations"),
        (["listen=a,b"], FLAGS, "listen"),
        (["seed=1..2"], (*FLAGS, "--run=mine"), "run"),
        (["share=1,1000"], FLAGS, "--share"),
    ],
)
def test_a_value_that_coordinator_refuses_is_refused_before_anything_starts(vary, flags, named):
    with pytest.raises(UsageError, match=named):
        check_runs(sweep_of(*vary, flags=flags), SOURCES)


def test_the_tasks_of_all_runs_are_announced_and_by_a_worker_all_that_its_flags_name():
    sweep = sweep_of("task=gym:CartPole-v1,gym:Acrobot-v1", flags=FLAGS[1:])
    assert check_runs(sweep, SOURCES) == ("gym:CartPole-v1", "gym:Acrobot-v1")
    parsed = build_parser("worker", worker).parse_all(task_flags("dream", "gym:mine:Own-v0", "mine:Task"))
    assert parsed.task == ["gym:mine:Own-v0", "mine:Task"]


def test_a_sweep_is_kept_and_read_as_it_was(folder):
    sweep = sweep_of("seed=1..2", "sigma0=0.05,0.1")
    stored = StoredSweep(sweep, ("gym:CartPole-v1",))
    folder.write(stored)
    assert folder.read() == stored
    assert "options" not in json.loads((folder.path / SETTINGS).read_text())
    with pytest.raises(UsageError, match="--resume carts"):
        folder.check_new(sweep)


def resumed(*words):
    """How a sweep that was begun with six workers is served when it is resumed with these flags."""
    parser = build_parser("sweep", sweep_verb)
    kept = SweepOptions(parallel=2, workers=6, listen=("tcp/0.0.0.0:7447",), insecure=True)
    args = parser.parse_all(["--resume", "carts", *words])
    complete_arguments(args, {})
    return sweep_verb._options(args, {}, kept)


def test_a_sweep_is_resumed_as_it_was_served(folder):
    kept = resumed()
    assert kept == SweepOptions(2, 6, ("tcp/0.0.0.0:7447",), (), insecure=True)
    folder.write(StoredSweep(sweep_of("seed=1..2"), (), kept))
    assert folder.read().options == kept
    assert resumed("--workers", "0", "--parallel", "1") == replace(kept, workers=0, parallel=1)
    assert resumed("--connect", "tcp/a:1") == SweepOptions(2, 6, (), ("tcp/a:1",))
    assert resumed("--listen", "tcp/127.0.0.1:1") == SweepOptions(2, 6, ("tcp/127.0.0.1:1",))


CODE_FLAGS = [
    ("--task=function:pickle:loads",), ("--task", "mine:Task"), ("--optimiser=pickle:loads",), ("--trust=pickle",),
    ("--environment", "x=1", "--trust", "pickle"),
]  # fmt: skip


def run_sweep(folder, *words):
    args = build_parser("sweep", sweep_verb).parse_all([*words, "--runs-dir", str(folder.runs_dir)])
    complete_arguments(args, {})
    return sweep_verb.run(args)


@pytest.mark.parametrize(
    ("sweep", "announced", "said"),
    [
        *((sweep_of("seed=1", flags=(*each, "--generations=1")), (), "--trust (pickle|mine)") for each in CODE_FLAGS),
        (sweep_of("seed=1"), ("function:pickle:loads",), "."),
        (sweep_of("seed=1", "task=function:pickle:loads", flags=FLAGS[1:]), (), "."),
        (sweep_of("seed=1", flags=(*FLAGS, "--config", "strangers.toml")), (), "."),
        (sweep_of("seed=1", flags=(*FLAGS, "--join=strangers")), (), "."),
    ],
)
def test_a_kept_sweep_chooses_and_announces_no_code_and_names_no_file_of_settings(
    folder, sweep, announced, said, monkeypatch
):
    monkeypatch.setattr(sweep_verb, "_serve", lambda *_args: pytest.fail("it was served"))
    folder.write(StoredSweep(sweep, announced))
    with pytest.raises(UsageError, match=said):
        run_sweep(folder, "--resume", "carts")


def test_a_sweep_that_this_user_began_here_keeps_its_code(folder, tmp_path, monkeypatch):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "swept_costs.py").write_text("def cost(x):\n    return sum(x**2)\n")
    monkeypatch.syspath_prepend(str(tmp_path / "own"))
    served = []
    monkeypatch.setattr(sweep_verb, "_serve", lambda _args, stored, *_rest: served.append(stored) or [])
    monkeypatch.setattr(sweep_verb, "_report", lambda *_args: 0)

    def forget():
        monkeypatch.setenv(VARIABLE, "")
        monkeypatch.delitem(sys.modules, "swept_costs", raising=False)

    flags = ("--task=function:swept_costs:cost", "--environment", "x0=[1.0,2.0]", "minimise=true", "--generations=1")
    run_sweep(folder, "--run", "carts", "--vary", "seed=1", *flags)
    forget()
    run_sweep(folder, "--resume", "carts")
    assert served[0].tasks == served[1].tasks == ("function:swept_costs:cost",)
    forget()
    changed = replace(served[0].sweep, flags=(*served[0].sweep.flags, "--population=5"))  # not this user's words
    folder.write(replace(served[0], sweep=changed))
    with pytest.raises(UsageError, match="--trust swept_costs"):
        run_sweep(folder, "--resume", "carts")


def test_a_sweep_that_is_absent_or_damaged_is_named(folder):
    with pytest.raises(UsageError, match="carts"):
        folder.read()
    for text in ("{", "[]", '{"name": "carts"}', "null"):
        (folder.path / SETTINGS).write_text(text)
        with pytest.raises(DreamfleetError, match=r"sweep\.json"):
            folder.read()


def result(setting, scores, *, ended=True):
    return RunResult("a run", setting, ended, scores, (), ())


def test_settings_are_compared_by_the_strongest_score_that_all_runs_have():
    confirmed, other = result("s", {CONFIRMED: 1.0, FITNESS: 5.0}), result("s", {FITNESS: 3.0})
    assert judged_by([confirmed]) == CONFIRMED
    assert judged_by([confirmed, other]) == FITNESS
    assert judged_by([]) is None
    assert judged_by([result("s", {FITNESS: 1.0}, ended=False)]) is None


def test_a_setting_has_the_mean_of_its_finished_runs_and_the_error_among_them():
    runs = [result("one", {FITNESS: 1.0}), result("one", {FITNESS: 3.0}), result("two", {FITNESS: 7.0})]
    one, two = summary.means([*runs, result("one", {FITNESS: 99.0}, ended=False)], FITNESS)
    assert (one.setting, one.runs, one.mean, one.error) == ("one", 2, 2.0, 1.0)
    assert (two.runs, two.mean, two.error) == (1, 7.0, None)


def test_settings_that_gave_the_same_are_named():
    def scored(setting, *means):
        curve = tuple(CurvePoint(number, 10, mean) for number, mean in enumerate(means))
        return RunResult(setting, setting, True, {FITNESS: means[-1]}, (), curve)

    runs = [scored("a", 1.0, 5.0), scored("b", 1.0, 5.0), scored("c", 2.0, 5.0), scored("d", 2.0, 4.0)]
    equal = find_equal(runs, FITNESS)
    assert [re.findall(r"\b[a-d]\b", each) for each in equal] == [["a", "b"], ["a", "c"], ["b", "c"]]
    assert len({re.sub(r"\b[a-d]\b", "", each) for each in equal}) == 2, "in each generation, or only in their scores"


def test_runs_with_few_evaluations_are_drawn_by_their_generations_and_each_line_has_its_dashes():
    curve = tuple(CurvePoint(number, 10 * number, 1.0) for number in range(4))
    labels = set()
    for evaluated in (curve[:2], curve):
        figure = sweep_figure([RunResult(name, name, True, {}, evaluated, curve) for name in ("one", "two")])
        axes = figure.axes[0]
        labels.add(axes.get_ylabel())
        thick = [each for each in axes.lines if each.get_linewidth() == 2]
        assert len({(each.get_marker(), str(each._dash_pattern)) for each in thick}) == 2
    assert len(labels) == 2


def test_a_settings_curve_is_over_the_generations_that_all_its_runs_have():
    one = [CurvePoint(0, 10, 1.0), CurvePoint(1, 20, 2.0), CurvePoint(2, 30, 9.0)]
    other = [CurvePoint(0, 12, 3.0), CurvePoint(1, 22, 6.0)]
    assert summary.mean_curve([one, other]) == [(11, 2.0, 1.0), (21, 4.0, 2.0)]
