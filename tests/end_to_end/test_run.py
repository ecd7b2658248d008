"""A run with a task that scores in no time: what its coordinator, workers, status and journal do.

Tests common/verbs/control.py, coordinator/service/main.py, coordinator/service/name_lock.py,
coordinator/verbs/coordinator.py, coordinator/addons/quality_diversity/archive_plot.py, worker/verbs/worker.py,
coordinator/jobs/evaluation.py and coordinator/settings/fork.py.
"""

import json
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dreamfleet
from dreamfleet.common.addons.analysis.run_archive import RunArchive
from dreamfleet.common.protocol.stop_kind import StopKind
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.coordinator.settings.start import latest_mean_and_sigma
from tests.support import tasks
from tests.support.processes import DEADLINE, ROOT, call_here, free_port, printed, until
from tests.support.same_bits import evolve

OWN = "tests.support.optimisers:ParentsAndChildren"


@pytest.mark.slow
def test_a_worker_that_started_first_waits_fetches_the_bundle_and_leaves_when_the_run_is_over(processes, small):
    worker = processes.worker("--task", tasks.TOY, "--exit-when-done")
    worker.wait_for_event("no coordinator")
    coordinator = processes.coordinator(*small, "--task", tasks.TOY, "--generations", 3)
    worker.wait_for_event("fetched")
    assert coordinator.finish()[0] == 0
    assert worker.finish()[0] == 0
    with open_run(processes.runs, "test") as run:
        assert [each.number for each in run.history()] == [0, 1, 2]


def test_the_mean_is_evaluated_on_schedule_and_at_the_end_and_the_target_ends_the_run(processes, small):
    evolve(
        processes, "test", 1, *small, "--task", tasks.TOY, "--population", 8, "--sigma0", 0.2, "--evaluate-every", 5,
        "--evaluation-episodes", 3, "--generations", 400, "--target", -4, task=tasks.TOY,
    )  # fmt: skip
    with open_run(processes.runs, "test") as run:
        evaluations = run.evaluations()
        assert [each.generation % 5 for each in evaluations[:-1]] == [4] * (len(evaluations) - 1)
        assert max(each.mean for each in evaluations) >= -4
        assert run.stop_kind is StopKind.TARGET
        seeds = [each.seed for each in run.results(4, 0, "evaluate")]
    assert seeds[:3] == [20000, 20001, 20002], "those that confirm come later"


@pytest.mark.slow
def test_status_is_json_that_zenoh_cli_reads_too(processes, small):
    coordinator = processes.coordinator(*small)
    processes.worker("--task", tasks.SLOW_TOY)
    coordinator.wait_for_event("generation", number=1)
    ours = processes.status()
    assert (ours["schema"], ours["run"], ours["state"], ours["slots"]) == (2, "test", "running", 1)
    assert ours["worker_list"][0]["state"] == "present"
    tool = Path(sys.executable).parent / "zenoh"
    command = [tool, "--mode", "client", "--connect", processes.endpoint, "get", "-s", "dreamfleet/v2/test/status"]
    done = subprocess.run([*command, "--decoder", "json"], capture_output=True, text=True, timeout=DEADLINE, check=True)
    theirs = done.stdout[done.stdout.index("{") :]
    assert json.JSONDecoder().raw_decode(theirs)[0]["run_uid"] == ours["run_uid"]
    assert processes.call("status", "--connect", processes.endpoint)[0] == 0


def test_a_second_coordinator_of_a_live_run_and_a_foreign_one_of_its_name_are_refused(processes, small, tmp_path):
    processes.coordinator(*small)
    elsewhere = ("--listen", f"tcp/127.0.0.1:{free_port()}")
    assert call_here("coordinator", "--resume", "test", "--runs-dir", processes.runs, *elsewhere)[0] != 0
    foreign = ("--run", "test", "--runs-dir", tmp_path / "elsewhere", "--connect", processes.endpoint)
    assert call_here("coordinator", *foreign, *small)[0] != 0
    assert not (tmp_path / "elsewhere").exists(), "a run that cannot be served is not created"


@pytest.mark.parametrize("flag", ["--listen", "--metrics-port"])
def test_a_new_run_whose_port_is_taken_is_not_created(processes, small, flag):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = f"127.0.0.1:{other.getsockname()[1]}"
        where = ("--listen", f"tcp/{taken}") if flag == "--listen" else ("--listen", processes.endpoint, flag, taken)
        code, _, err = call_here("coordinator", "--run", "test", "--runs-dir", processes.runs, *where, *small)
    assert (code, taken in err, flag in err) == (1, True, True), err
    assert not processes.runs.exists()


@pytest.mark.slow
def test_pause_resume_and_drain_from_the_command_line(processes, small):
    coordinator = processes.coordinator(*small)
    processes.worker("--task", tasks.SLOW_TOY)
    coordinator.wait_for_event("generation", number=0)

    def say(*words):
        return processes.printed(*words, "--connect", processes.endpoint)

    assert json.loads(say("pause", "--json")) == {"run": "test", "asked": "pause", "accepted": True}
    assert processes.status()["state"] == "paused"
    assert json.loads(say("resume", "test", "--json"))["accepted"]
    coordinator.wait_for_event("generation", times=2)
    drained = json.loads(say("drain", "test", "--json"))
    assert coordinator.finish()[0] == 130
    assert coordinator.lines[-1].rstrip().endswith(drained["continue"])
    assert f"--resume test --runs-dir {processes.runs}" in drained["continue"]
    with open_run(processes.runs, "test") as run:
        assert run.ended is None
        number = len(run.history())
        assert len([each for i in range(4) for each in run.results(number, i)]) <= 4


@pytest.mark.slow
def test_a_fork_begins_where_its_run_was_and_may_change_what_is_frozen(processes, small):
    toy = (*small, "--task", tasks.TOY)
    evolve(processes, "test", 1, *toy, "--generations", 3, task=tasks.TOY)
    own = ("--optimiser", OWN, "--optimiser-options", "parents=1")
    fork = processes.fork("test", "--population", 6, *own, "--generations", 1)
    processes.worker("--task", tasks.TOY, "--run", "test-fork")
    assert fork.finish()[0] == 0
    with open_run(processes.runs, "test") as one, open_run(processes.runs, "test-fork") as other:
        before, sigma = latest_mean_and_sigma(one)
        start = other.history()[0]
        assert other.settings.population == 6
        assert (other.settings.optimiser, other.settings.optimiser_options) == (OWN, ("parents=1",))
        assert start.sigma == pytest.approx(sigma)
        population = np.stack([other.candidate(0, i) for i in range(6)])
        assert np.abs(population - before).max() < 6 * sigma
        assert np.abs(before).max() > 0


def start(processes, folder, *words):
    coordinator = processes.start("coordinator", "--runs-dir", processes.folder / folder, *words)
    coordinator.wait_for_event("begin")
    return coordinator


def check_that_leaves(leaving, staying):
    until(lambda: leaving.popen.poll() is not None)
    assert leaving.finish()[0] == 1
    assert staying.popen.poll() is None


@pytest.mark.slow
def test_of_two_on_routers_that_are_linked_later_the_newcomer_leaves_and_the_other_goes_on(processes, small):
    first_at, second_at = processes.endpoint, f"tcp/127.0.0.1:{free_port()}"
    first = start(processes, "a", "--run", "test", "--listen", first_at, *small)
    second = start(processes, "b", "--run", "test", "--listen", second_at, *small)
    for coordinator, endpoint in ((first, first_at), (second, second_at)):
        processes.worker("--task", tasks.SLOW_TOY, endpoint=endpoint)
        coordinator.wait_for_event("generation", number=0)
    with open_session(Network(listen=(f"tcp/127.0.0.1:{free_port()}",), connect=(first_at, second_at))):
        check_that_leaves(second, first)
        first.wait_for_event("generation", times=2)
    with open_run(processes.folder / "b", "test") as run:
        assert len(run.history()) >= 1


@pytest.mark.slow
def test_a_frozen_predecessor_that_comes_back_leaves_and_its_token_hurts_nobody(processes, small):
    """Both are clients of one router: the token of the frozen one lingers until its lease is over."""
    with open_session(Network(listen=(processes.endpoint,))):
        words = ("--connect", processes.endpoint)
        made = start(processes, "a", "--run", "test", *words, *small)
        made.stop()
        old = start(processes, "a", "--resume", "test", *words)
        shutil.copytree(processes.folder / "a", processes.folder / "b")
        old.popen.send_signal(signal.SIGSTOP)
        new = start(processes, "b", "--resume", "test", *words)
        assert new.events("begin", incarnation=3)
        old.popen.send_signal(signal.SIGCONT)
        check_that_leaves(old, new)
        processes.worker("--task", tasks.SLOW_TOY)
        new.wait_for_event("generation", number=0)


LEFT_OUT = shutil.ignore_patterns("addons", "__pycache__")


@pytest.mark.slow
def test_a_run_needs_no_add_on(tmp_path, processes):
    """The entry points stay, as they are metadata of the installation: one whose module is gone counts as absent."""
    tree = tmp_path / "tree"
    shutil.copytree(ROOT / "dreamfleet", tree / "dreamfleet", ignore=LEFT_OUT)
    small = ("--generations", 2, "--population", 4, "--episodes", 1, "--confirm-episodes", 2)
    coordinator = processes.coordinator("--task", "gym:CartPole-v1", *small, root=tree)
    worker = processes.worker("--exit-when-done", root=tree)
    gone = processes.start("inspect", "--help", root=tree)
    assert [each.finish()[0] for each in (coordinator, worker)] == [0, 0]
    assert gone.finish()[0] == 1  # so it is that tree which runs
    with open_run(processes.runs, "test") as run:
        assert len(run.history()) == 2
        assert run.confirmation().episodes == 2


AXES = ("action0=-0.5:0.5:6", "action1=-0.5:0.5:6")
POPULATION = 6


@pytest.mark.slow
def test_the_elites_of_a_run_are_shown_drawn_judged_and_exported(processes, small):
    evolve(
        processes, "test", 1, *small, "--task", tasks.TOY, "--population", POPULATION, "--episodes", 2,
        "--sigma0", 0.2, "--generations", 5, "--archive", *AXES, "--optimiser", "map-elites", task=tasks.TOY,
    )  # fmt: skip
    with open_run(processes.runs, "test") as run:
        vectors = np.stack([run.candidate(each.number, i) for each in run.history() for i in range(POPULATION)])
        archive = RunArchive.of(run)
        assert len(run.measured_candidates()) == 5 * POPULATION

    runs = ("--runs-dir", processes.runs)
    facts = json.loads(printed("runs", "show", "test", *runs, "--json"))["archive"]
    assert (facts["cells"], facts["filled"]) == (36, len(archive.elites))
    assert facts["best"]["fitness"] == archive.best.fitness
    cell = ",".join(map(str, archive.best.cell))
    code, _, err = call_here("evaluate", "--controller", "test", *runs, "--cell", cell, "--episodes", 1)
    assert (code, archive.describe_elite(archive.best) in err) == (0, True), err
    picture, folder = processes.folder / "archive.svg", processes.folder / "tables"
    printed("runs", "plot", "test", *runs, "--kind", "archive", "--out", picture)
    assert picture.stat().st_size > 5_000
    with dreamfleet.open_run("test", processes.runs) as run:
        frame, figure = run.to_pandas("elites"), run.plot("archive")
    assert len(frame) == len(archive.elites)
    assert list(frame.columns)[:3] == ["cell.action0", "cell.action1", "action0"]
    axes = figure.axes[0]
    numbers = [[label.get_text() for label in each.get_xticklabels()] for each in (axes, axes.child_axes[0])]
    assert numbers == [["-0.5", "-0.333", "-0.167", "0", "0.167", "0.333", "0.5"], ["0", "1", "2", "3", "4", "5"]]
    assert f"--cell {cell}" in axes.get_title().replace("\n", " ")
    printed("runs", "export", "test", *runs, "--csv", "--out", folder)
    with np.load(folder / "elites.npz") as elites:
        parameters = elites["parameters"][np.argmax(elites["fitness"])]
    assert np.array_equal(parameters, vectors[archive.best.generation * POPULATION + archive.best.candidate])
