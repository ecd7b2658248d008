"""A run that a program starts: real coordinator and workers on this host, which end with it in every case.

Tests dreamfleet/experiments/local/run_arguments.py, dreamfleet/experiments/local/kept_words.py and
dreamfleet/experiments/local/local_run.py.
"""

import os
import shutil
import signal
import subprocess
import sys
import uuid
from contextlib import ExitStack, nullcontext
from unittest.mock import Mock, PropertyMock

import psutil
import pytest

from dreamfleet.common.artifacts.bundle import MANIFEST
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import DreamfleetError, StoppedError, UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.coordinator.addons.runs.stored_run import open_run
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.experiments.started_run import (
    RunPausedError,
    StartedRun,
    _claim,
    _free_name,
    check_settings,
    evolve,
    start_run,
)
from tests.support.bundles import rewrite
from tests.support.processes import DEADLINE, ROOT, environment, until
from tests.support.tasks import RAISING

SMALL = {"task": "gym:CartPole-v1", "population": 4, "episodes": 2, "evaluate_every": 0, "workers": 1}
MARK = "MARK_OF_A_TEST"


@pytest.fixture
def alive(monkeypatch):
    """A function: the processes that this test started, and those that they started."""
    mark = uuid.uuid4().hex
    monkeypatch.setenv(MARK, mark)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))

    def alive():
        seen = {each.pid: each.info["environ"] or {} for each in psutil.process_iter(["environ"])}
        return [pid for pid, variables in seen.items() if variables.get(MARK) == mark and pid != os.getpid()]

    yield alive
    for pid in alive():
        os.kill(pid, signal.SIGKILL)


@pytest.mark.slow
def test_generations_come_as_they_close_and_the_journal_stays(alive, tmp_path):
    with start_run(run="pole", generations=40, runs_dir=tmp_path, **SMALL) as run:
        assert alive()
        with Client(run.address) as client:
            assert client.runs() == ["pole"]
        assert run.address in run._repr_html_()
        seen = [next(iter(run)).number]
        seen += [generation.number for generation in run]  # goes on where the first loop stopped
    assert seen == list(range(40))
    until(lambda: not alive(), "its processes end")
    assert (run.state, len(run.history()), run.controller().task) == ("ended: 40 generations", 40, "gym:CartPole-v1")
    assert {each.name for each in tmp_path.joinpath("pole").glob("*.log")} == {"coordinator.log", "core-0.log"}
    run.close()
    with evolve(resume="pole", generations=42, workers=1, runs_dir=tmp_path) as run:
        assert [each.number for each in run.history()] == list(range(42))
    assert evolve(resume="pole", workers=1, runs_dir=tmp_path).ended == "42 generations"  # nothing was left to do


@pytest.mark.slow
@pytest.mark.parametrize(
    ("callback", "error"),
    [
        (lambda *_: False, None),
        (lambda _generation, run: run.end(), None),
        (lambda *_: {}["of the callback"], LookupError),
        (lambda *_: signal.raise_signal(signal.SIGINT), KeyboardInterrupt),
    ],
)
def test_a_run_that_is_left_early_ends_its_processes_and_stays_open(alive, tmp_path, callback, error):
    with nullcontext() if error is None else pytest.raises(error):
        evolve(callback, run="pole", runs_dir=tmp_path, **SMALL)
    assert not alive()
    with open_run("pole", tmp_path) as run:
        assert (run.state, len(run.history()) > 0) == ("open", True)


@pytest.mark.slow
def test_a_run_that_nothing_refers_to_ends(alive, tmp_path):
    run = start_run(runs_dir=tmp_path, **SMALL)
    assert alive()
    del run
    assert not alive()


PARENT = """
import os, signal, sys, dreamfleet
with dreamfleet.start_run(task="gym:CartPole-v1", evaluate_every=0, workers=2, runs_dir=sys.argv[1]) as run:
    for generation in run:
        os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends children with a killed parent")
def test_a_parent_that_is_killed_leaves_no_process(alive, tmp_path):
    words = [sys.executable, "-c", PARENT, tmp_path]
    done = subprocess.run(words, env=environment(tmp_path), check=False, timeout=DEADLINE)
    assert done.returncode == -signal.SIGKILL
    until(lambda: not alive(), "its processes end")


@pytest.mark.slow
def test_a_worker_that_dies_is_named_and_so_is_a_stop_from_elsewhere(alive, tmp_path):
    with start_run(run="pole", runs_dir=tmp_path, **SMALL) as run:
        (worker,) = run._processes._workers
        worker.popen.kill()
        with pytest.raises(DreamfleetError, match="9"):
            run.wait()
    with start_run(resume="pole", runs_dir=tmp_path, workers=1) as run:
        run.client.control("pole", "stop")
        with pytest.raises(StoppedError, match="pole"):
            run.wait()
    assert not alive()


@pytest.mark.slow
def test_a_run_goes_on_while_one_of_its_own_workers_may_score(tmp_path):
    with start_run(run="pole", runs_dir=tmp_path, **{**SMALL, "workers": 2, "generations": 10**6}) as run:
        while not any(worker.name == "core-1" for worker in run.client.workers("pole")):
            assert run._processes._workers[1].popen.poll() is None
        run.client.control("pole", "bar", "core-1")
        assert run._processes._workers[1].popen.wait(DEADLINE)
        assert "bar core-1 pole --no-longer" in run._processes._workers[1].last_line()
        closed = len(run.history())
        assert any(each.number > closed for each in run)


def test_a_worker_that_is_killed_as_it_leaves_an_ended_run_is_no_error(tmp_path):
    shutil.copytree(ROOT / "tests" / "fixtures" / "runs" / "reality", tmp_path / "reality")
    leaving = Mock()  # the coordinator exits, and its worker did not do so in time
    type(leaving.coordinator).exit_code = PropertyMock(side_effect=(None, 0))
    leaving.check_workers.side_effect = DreamfleetError("killed by signal 14")
    with StartedRun(tmp_path / "reality", leaving, "", None, resumed=False) as run:
        run.end_with(ExitStack())
        assert [each.number for each in run] == [0, 1, 2]


@pytest.mark.slow
def test_a_pause_is_no_endless_wait(alive, tmp_path, random_bundle):
    rough = {"task": RAISING, "bundle": random_bundle.path, "on_failure": "pause", "population": 3, "episodes": 1}
    with start_run(runs_dir=tmp_path, **{**SMALL, **rough}) as run, pytest.raises(RunPausedError) as paused:
        run.wait()
    assert paused.value.errors


@pytest.mark.slow
def test_a_wrong_setting_starts_nothing(alive, tmp_path):
    (tmp_path / "runs" / "pole").mkdir(parents=True)
    (tmp_path / "runs" / "pole" / "journal.sqlite").touch()
    for settings, named in (
        ({"tsak": "gym:CartPole-v1"}, "'tsak'.* 'task'"),
        ({"population": "many"}, "--population.*'many'"),
        ({"workers": -1}, "-1"),
        ({"join": "me.join"}, "'join'"),
        ({"run": "No Name"}, "No Name"),
        ({"run": "pole", **SMALL}, "'pole'"),
        ({"task": "gym:Nowhere-v1"}, "'Nowhere-v1'"),  # the coordinator's words
    ):
        with pytest.raises(UsageError, match=named):
            start_run(runs_dir=tmp_path / "runs", **settings)
    assert not alive()
    assert [path.name for path in tmp_path.glob("runs/*")] == ["pole"]


@pytest.mark.slow
def test_two_programs_that_start_one_name_at_once_share_nothing(alive, tmp_path):
    with start_run(run="pole", generations=10**6, runs_dir=tmp_path, **SMALL) as run:
        log = (tmp_path / "pole" / "coordinator.log").read_text()
        for again in ({"run": "pole"}, {"resume": "pole"}):
            with pytest.raises(UsageError, match="pole"):
                start_run(runs_dir=tmp_path, **{**SMALL, **again})
        assert (tmp_path / "pole" / "coordinator.log").read_text().startswith(log)
        next(iter(run))
    with _claim(tmp_path / "new"), pytest.raises(UsageError, match="new"):
        start_run(run="new", generations=1, runs_dir=tmp_path, **SMALL)
    assert evolve(run="new", generations=1, runs_dir=tmp_path, **SMALL).ended == "1 generation"
    assert len({_free_name(tmp_path) for _ in range(3)}) == 3


def test_settings_are_the_flags_of_the_coordinator():
    given = {
        "task": "gym:CartPole-v1", "environment": {"sutton_barto_reward": True, "render_mode": "rgb_array"},
        "optimiser_options": ("a=1", "b=2"), "normalise": True, "racing": False, "target": -5.5, "patience": None,
        "run": "pole", "listen": "tcp/127.0.0.1:1",
    }  # fmt: skip
    assert check_settings(given) == (
        "--task=gym:CartPole-v1",
        *("--environment", "sutton_barto_reward=true", "render_mode=rgb_array"),
        *("--optimiser-options", "a=1", "b=2"),
        *("--normalise", "--no-racing", "--target=-5.5"),
    )


@pytest.mark.slow
def test_a_world_model_chooses_no_code_of_the_workers(alive, tmp_path, random_bundle):
    path, task = tmp_path / "strangers.zip", random_bundle.manifest.task
    path.write_bytes(random_bundle.path.read_bytes())
    wanted = b'"gym:strangers_choice:Env-v0"'
    rewrite(path, lambda name, data: data.replace(f'"{task}"'.encode(), wanted) if name == MANIFEST else data)
    with pytest.raises(UsageError, match="--trust strangers_choice"):
        start_run(bundle=path, generations=1, runs_dir=tmp_path / "runs", **{**SMALL, "task": "dream"})
    assert not alive()


@pytest.mark.parametrize("module", ["strangers_choice", "pickle"])  # also one that this process has loaded
def test_a_runs_folder_chooses_no_code_of_the_workers(alive, tmp_path, module):
    shape = ControllerShape(4, 2)
    spec = TaskSpec(task=f"gym:{module}:Env-v0", bundle="", horizon=1, patience=0, controller=shape)
    (tmp_path / "theirs").mkdir()
    Journal.create(tmp_path / "theirs", RunSettings(spec, shape, 4, 1, 0.1, "diagonal", 1, 0, 1), None).close()
    with pytest.raises(UsageError, match=f"--trust {module}"):
        start_run(resume="theirs", runs_dir=tmp_path)
    assert not alive()
