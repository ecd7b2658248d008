"""Watching a run from anywhere, to its end, and judging what it reports.

Tests common/client/client.py, coordinator/addons/status/verb.py, coordinator/service/queryables.py and
coordinator/addons/metrics/metrics_server.py.
"""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
import uuid

import pytest
from prometheus_client.parser import text_string_to_metric_families

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError, ControllerError
from dreamfleet.common.host.processes import command
from dreamfleet.common.host.reports import ADDRESS
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.coordinator.addons.status import verb as status
from tests.support import tasks
from tests.support.processes import DEADLINE, call_here, environment, free_port, refused
from tests.support.served import serving, snapshot


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
        assert worker.stop()[0] == 0
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
    out = processes.printed("evaluate", *live, "--episodes", 2, "--jobs", 1, "--json")
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


NAMES = [f"a-host-of-thirty-letters-x{number:04d}" for number in range(2)]


class Terminal:
    """A tmux server of its own with one window."""

    def __init__(self, words, env):
        self._socket = f"dreamfleet-{uuid.uuid4().hex}"
        named = [f"{name}={value}" for name, value in env.items() if name not in ("COLUMNS", "TERM", "TMUX")]
        line = shlex.join(["env", "-u", "COLUMNS", *named, *words])
        self._call("new-session", "-d", "-x", "80", "-y", "24", f"{line}; printf over; cat")

    def wait_for(self, *texts):
        """The lines of the screen, once it has these texts."""
        deadline = time.monotonic() + DEADLINE
        while not all(text in (seen := self._call("capture-pane", "-p")) for text in texts):
            assert time.monotonic() < deadline, seen
        return seen.splitlines()

    def end(self):
        subprocess.run(["tmux", "-L", self._socket, "kill-server"], check=False, capture_output=True)

    def _call(self, *words):
        done = subprocess.run(["tmux", "-L", self._socket, *words], check=True, capture_output=True, text=True)
        return done.stdout


@pytest.fixture
def terminal(processes):
    words = command("status", "--connect", processes.endpoint, "--watch")
    made = Terminal(words, environment(processes.cache))
    yield made
    made.end()


@pytest.mark.slow
@pytest.mark.needs_programs("tmux")
def test_a_watcher_sees_the_whole_run_in_24_lines_and_at_last_its_end(processes, terminal, small):
    coordinator = processes.coordinator(*small, "--episodes", 2, "--generations", 4)
    terminal.wait_for("waiting for workers")
    for name in NAMES:
        processes.worker("--task", tasks.SLOW_TOY, "--name", name)
    seen = terminal.wait_for(*NAMES)
    assert max(map(len, seen)) <= 80
    assert not any("…" in line for line in seen)
    assert coordinator.finish()[0] == 0
    last = terminal.wait_for("over")
    assert last[0].startswith("╭─ test · ")
    assert "4 generations" in last[1]


TOKEN = "correct horse battery"


def read(port, path="/metrics"):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=DEADLINE) as answer:
        text = answer.read().decode()
    return {sample.name: sample for family in text_string_to_metric_families(text) for sample in family.samples}


@pytest.mark.slow
def test_a_coordinator_answers_prometheus(processes, small):
    port = free_port()
    coordinator = processes.coordinator(*small, "--task", tasks.TOY, "--metrics-port", port)
    assert read(port)["dreamfleet_generation"].value == 0
    processes.worker("--task", tasks.TOY, "--name", "host-a")
    coordinator.wait_for_event("generation", number=1)
    while (found := read(port))["dreamfleet_generations_closed_total"].value < 1:
        pass  # a snapshot is a fifth of a second old
    assert found["dreamfleet_worker_slots"].labels["worker"].startswith("host-a/")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        read(port, "/")
    for wrong in ("none", "0", "host:", "70000"):
        refused("--metrics-port", "coordinator", "--run", "x", "--runs-dir", processes.runs, "--metrics-port", wrong)


def test_the_dashboard_answers_for_every_live_run_to_holders_of_the_token(processes):
    with serving(processes.endpoint, snapshot(workers=80), snapshot(name="lucid")):
        page = processes.start("dashboard", "--connect", processes.endpoint, "--port", 0, "--token", TOKEN)
        address = page.wait_for_report(ADDRESS)
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(f"{address}metrics", timeout=DEADLINE)
        asked = urllib.request.Request(f"{address}metrics", headers={"Authorization": f"Bearer {TOKEN}"})
        with urllib.request.urlopen(asked, timeout=DEADLINE) as answer:
            text = answer.read().decode()
    found = {each.name: each.samples for each in text_string_to_metric_families(text)}
    assert [each.labels["run"] for each in found["dreamfleet_generation"]] == ["lucid", "night"]
    assert sum(each.labels["run"] == "night" for each in found["dreamfleet_worker_slots"]) == 80, "not the head alone"
