"""Watching a run from anywhere, to its end, and judging what it reports.
Tests common/client/client.py, coordinator/addons/status/verb.py and coordinator/service/queryables.py."""

import json
import os
import signal
import sys

import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError, ControllerError
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.coordinator.addons.status import verb as status
from tests.support import tasks
from tests.support.processes import call_here


@pytest.mark.slow
def test_watchers_print_each_change_and_at_last_how_the_run_ended(processes, small):
    watch = ("status", "--connect", processes.endpoint, "--watch")
    watcher = processes.start(*watch, "--json")
    watcher.wait_for(processes.endpoint)
    coordinator = processes.coordinator(*small, "--generations", 2)
    panel = processes.start(*watch)
    processes.worker("--task", tasks.SLOW_TOY)
    assert coordinator.finish()[0] == 0
    (code, out), shown = watcher.finish(), panel.finish()
    seen = [json.loads(line) for line in out.splitlines()]
    assert code == 0
    assert (seen[-1]["state"], seen[-1]["why"], seen[-1]["generations"]) == ("ended", "2 generations", 2)
    assert len(seen) > 1
    with open_run(processes.runs, "test") as run:
        assert seen[-1]["last"]["mean"] == run.history()[-1].mean
    assert shown[0] == 0
    assert shown[1].startswith("test: "), "in a pipe, a line at each change"
    assert "2 generations" in shown[1]


@pytest.mark.slow
def test_a_watch_of_a_stopped_run_ends_and_of_a_killed_one_raises_as_every_question_does(processes, small):
    coordinator = processes.coordinator(*small)
    with Client((processes.endpoint,)) as client:
        watched = client.watch("test", 0.05)
        assert next(watched).state == "waiting for workers"
        coordinator.popen.send_signal(signal.SIGTERM)
        *_, last = watched
    assert last.state == "left"
    assert coordinator.finish()[0] == 130
    coordinator = processes.resume()
    coordinator.wait_until_serving()
    with Client((processes.endpoint,)) as client:
        watched = client.watch("test", 0.05)
        next(watched)
        coordinator.end()
        with pytest.raises(ConnectionFailedError):
            for _ in watched:
                pass
        for ask in (client.workers, client.history, client.controller):
            with pytest.raises(ConnectionFailedError):
                ask("test")


@pytest.mark.slow
def test_a_live_runs_controller_is_fetched_and_judged_on_another_host(processes, small, tmp_path):
    """One of many units, which travels in parts; the other host has neither runs nor bundles."""
    coordinator = processes.coordinator(*small, "--controller", "hidden", "--hidden-units", 40, "--task", tasks.TOY)
    with Client((processes.endpoint,)) as client:
        with pytest.raises(ControllerError):
            client.controller("test")
        worker = processes.worker("--task", tasks.TOY)
        coordinator.wait_for_event("generation", number=3)
        worker.popen.send_signal(signal.SIGTERM)
        assert worker.finish()[0] == 0
        with open_run(processes.runs, "test") as run:
            closed = len(run.history())
            here = Controller.load(run.controller_path)
        while client.status("test").generations < closed:
            pass  # a snapshot is a fifth of a second old, or more on a busy host
        there = client.controller("test")
        assert len(there.parameters) > 6000
        assert (there.shape, there.task, there.bundle) == (here.shape, here.task, here.bundle)
        assert there.provenance["generation"] >= here.provenance["generation"]
        parts = client.candidates("test", client.status().generation.number)
        assert sum(len(part.done) for part in parts) == 4
    live = ("--connect", processes.endpoint, "--run", "test", "--runs-dir", tmp_path / "nothing")
    code, out, err = processes.call("evaluate", *live, "--episodes", 2, "--jobs", 1, "--json")
    assert code == 0, err
    assert len(json.loads(out)["scores"]) == 2


def test_a_controller_from_here_and_one_from_a_live_run_exclude_each_other():
    for flags in ((), ("--controller", "tiny", "--run", "test"), ("--controller", "tiny", "--connect", "tcp/h:1")):
        code, _, err = call_here("evaluate", *flags)
        assert (code, "--controller" in err, "--run" in err) == (2, True, True), err


@pytest.mark.parametrize(("terminal", "redraws"), [("dumb", False), ("unknown", False), ("xterm", True)])
def test_a_terminal_that_cannot_draw_over_a_line_has_lines_as_a_pipe_has(monkeypatch, terminal, redraws):
    monkeypatch.setenv("TERM", terminal)
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    controller, device = os.openpty()
    with open(controller, "rb"), open(device, "w") as stdout:  # noqa: PTH123 - descriptors
        monkeypatch.setattr(sys, "stdout", stdout)
        assert status._can_redraw() == redraws
