"""What people get wrong: one clear line that says what to do, an exit code that is not 0, nothing lost.

Tests coordinator/optimisers/registry.py, coordinator/settings/config.py, coordinator/settings/freezing.py and
coordinator/settings/run_setup.py.
"""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from tests.support import tasks
from tests.support.processes import DEADLINE, ROOT, call_here, command, environment, printed, processes_in
from tests.support.tables import cells


def complains(*arguments, says):
    """What is refused before it starts anything says so in a line with this datum."""
    code, out, err = call_here(*arguments)
    assert (code in (1, 2), says in err.strip().splitlines()[-1], "Traceback" in err + out) == (True, True, False), err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--run", "No Good"), "'No Good'"),
        (("--preset", "huge"), "article, dream, frugal, mixed, notebook"),
        (("--bundle", "absent"), "'absent'"),
        (("--population", "1"), "--population"),
        (("--sigma0", "nan"), "--sigma0"),
        (("--horizon", "0"), "--horizon"),
        (("--population", "many"), "'many'"),
        (("--listen", "localhost"), "'localhost'"),
        (("--config", "absent.toml"), "absent.toml"),
        (("--resume", "never"), "'never'"),
        (("--target", "900", "--evaluate-every", "0"), "--target"),
        (("--parted", "3", "--evaluate-every", "0"), "--parted"),
        (("--collect-episodes", "8"), "--collect-episodes"),
        (("--temperature", "1.3"), "--temperature"),
        (("--task", "gym:CartPole-v1", "--features", "z"), "--features"),
        (("--task", "gym:CartPole-v1", "--controller", "linear", "--hidden-units", "16"), "--hidden-units"),
        (("--minutes", "-1"), "--minutes"),
        (("--run", "archive"), "archive"),
        (("--bundle", "able", "--init", "tiny"), " tiny "),
        (("--optimiser", "cmea"), "cma, cma-me, cmaes-lra"),
        (("--optimiser", "cmaes-sep", "--preset", "article"), "--covariance diagonal"),
        *(
            (("--task", tasks.TOY, "--optimiser", "external", *flags), flags[0])
            for flags in (("--racing",), ("--generations", 3), ("--on-failure", "redraw"), ("--evaluate-every", 5))
        ),
        (("--optimiser", "cma-me"), "--archive"),
        (("--archive", "steps=5"), "'steps=5'"),
        (("--archive", "steps=0:9:9", "steps=0:9:9"), "--archive"),
        (("--archive", "steps=0:1:200", "gas=0:1:200"), "40,000"),
        (("--task", "dream", "--archive", "truth.speed=0:1:9"), "truth.speed"),
        (("--task", "gym:Nothing-v0"), "'Nothing-v0'"),
        (("--task", "CartPole-v1"), "'CartPole-v1'"),
        (("--task", "gym:CartPole-v1", "--environment", "wings"), "wings"),
        (("--task", "gym:CartPole-v1", "--environment", "wings=2"), "wings"),
        (("--task", "gym:CartPole-v1", "--temperature", "1.5"), "--temperature"),
        (("--task", "gym:CartPole-v1", "--task-options", "[1]"), "--task-options"),
        (("--task", "car-racing", "--bundle", "none"), "car-racing"),
        (("--normalise",), "--normalise"),
    ],
)
def test_the_coordinator_complains(processes, arguments, says):
    complains("coordinator", "--runs-dir", processes.runs, *arguments, says=says)
    assert not processes.runs.exists() or not any(processes.runs.iterdir())


def test_a_damaged_bundle_starts_nothing(processes, tmp_path):
    broken = tmp_path / "broken.zip"
    broken.write_bytes(b"PK\x03\x04 half")
    complains("coordinator", "--bundle", broken, says="broken.zip")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
def test_an_unwritable_folder(processes, random_bundle):
    complains(
        "coordinator", "--runs-dir", "/proc/dreamfleet", "--bundle", random_bundle.path,
        "--listen", processes.endpoint, says="--runs-dir",
    )  # fmt: skip
    complains("collect", "--data", "/proc/dreamfleet", "--episodes", "1", says="--data")


@pytest.fixture(scope="module")
def begun(tmp_path_factory, random_bundle):
    """The folder of a run that has begun, which no test changes."""
    with processes_in(tmp_path_factory.mktemp("begun")) as processes:
        processes.coordinator("--bundle", random_bundle.path, "--task", tasks.TOY).end()
        yield processes.runs / "test"


def test_an_existing_run_is_not_begun_again(processes, begun):
    run = ("coordinator", "--runs-dir", begun.parent, "--listen", processes.endpoint)
    complains(*run, "--run", "test", says="--resume")
    complains(*run, "--resume", "test", "--population", "8", says="--population")


@pytest.fixture
def odd(begun, tmp_path):
    """A runs folder in which one run's folder is a link, and another holds a third."""
    runs = tmp_path / "odd"
    shutil.copytree(begun, runs / "whole")
    shutil.copytree(begun, runs / "outer" / "inner")
    shutil.copy(begun / "journal.sqlite", runs / "outer")
    (runs / "link").symlink_to(runs / "whole")
    (runs / "archive").write_text("no folder")
    (runs / "strange" / "journal.sqlite").mkdir(parents=True)
    return runs


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("runs", "delete", "link", "--yes"), "link"),
        (("runs", "delete", "outer", "--yes"), "inner"),
        (("runs", "archive", "whole"), "whole"),
        (("runs", "show", "strange"), "strange"),
    ],
)
def test_odd_folders_lose_nothing(processes, odd, words, says):
    complains(*words, "--runs-dir", odd, says=says)
    assert (odd / "whole" / "journal.sqlite").exists()
    assert (odd / "outer" / "inner" / "journal.sqlite").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("more", [(), ("--json",)])
def test_a_full_stdout_is_one_line(processes, odd, more):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            command("runs", "list", "--runs-dir", odd, *more), env=environment(processes.cache), stdout=full,
            stderr=subprocess.PIPE, check=False, text=True, timeout=DEADLINE,
        )  # fmt: skip
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1


def test_a_controller_of_another_shape(processes, tmp_path):
    path = tmp_path / "small.npz"
    Controller(ControllerShape(4, 3), np.zeros(15, np.float32), "car-racing", "ab" * 32).save(path)
    complains("evaluate", "--controller", path, "--bundle", "tiny", "--episodes", "1", says="tiny.zip")
    complains("evaluate", "--controller", path, "--episodes", "1", says="--bundle")
    complains("evaluate", "--controller", "absent", says="'absent'")
    complains("record", "--controller", path, "--out", "drive.avi", says="drive.avi")


@pytest.mark.slow
def test_a_worker_or_viewer_without_a_coordinator(processes):
    complains("status", "--connect", processes.endpoint, says=processes.endpoint)
    complains("worker", "--connect", "nowhere", says="'nowhere'")
    complains("worker", "--connect", processes.endpoint, "--run", "No!", says="'No!'")
    complains("worker", "--connect", processes.endpoint, "--slots", "-1", says="--slots")
    complains("worker", "--any", "--exit-when-done", says="--any")


def test_runs_that_do_not_exist(processes):
    candidate = ("verify", "candidate", "--candidate", "0/0")
    for verb in (("runs", "show"), ("runs", "delete"), ("runs", "archive"), candidate):
        complains(*verb, "night", "--runs-dir", processes.runs, says="'night'")
    complains("verify", "candidate", "night", "--candidate", "first", says="'first'")


def test_a_run_is_listed_shown_archived_and_deleted(processes):
    runs = ("--runs-dir", processes.runs)
    shutil.copytree(ROOT / "tests" / "fixtures" / "runs" / "dream", processes.runs / "test")
    complains("runs", "delete", "test", *runs, says="--yes")
    _, shown, _ = call_here("runs", "show", "test", *runs)
    rows = [cells(line) for line in shown.splitlines()]
    assert ["task", "dream"] in rows
    assert [row[0] for row in rows[-2:]] == ["10", "11"], "a line a generation"
    answer = json.loads(printed("runs", "archive", "test", *runs, "--json"))
    assert answer["archived"] == str(processes.runs / "archive" / "test")
    assert "test" not in call_here("runs", "list", *runs)[1]
    assert "test" in call_here("runs", "list", "--archived", *runs)[1]
    archive = ("--runs-dir", processes.runs / "archive")
    assert "\ntest " in call_here("runs", "list", *archive)[1]
    assert json.loads(printed("runs", "delete", "test", "--yes", *archive, "--json"))["run"] == "test"


@pytest.mark.slow
def test_the_doctor_finds_this_installation_well(processes):
    code, out, _ = processes.call("doctor")
    assert code == 0, out
