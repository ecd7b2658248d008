"""What a coordinator and its workers say of one another.

Tests coordinator/addons/runs/story_verb.py, common/host/logs.py, coordinator/addons/sinks/live_log.py,
coordinator/dispatch/event_log.py and coordinator/service/run_log.py.
"""

import json
import os
import shlex
import signal
from collections import Counter
from pathlib import Path

import pytest

from dreamfleet.common.protocol import keys
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.coordinator.addons.runs.export import scalars_of
from dreamfleet.coordinator.service.status import encode_part
from tests.support import tasks
from tests.support.events import scalars
from tests.support.processes import call_here, printed, refused
from tests.support.served import snapshot


@pytest.mark.slow
def test_a_json_log_is_json_and_says_how_to_start_a_worker(processes, small):
    coordinator = processes.coordinator(*small, "--task", tasks.TOY, "--log-format", "auto")
    record = coordinator.wait_for_event("no worker")
    program, *words = shlex.split(record["command"])
    assert program == "dreamfleet"
    worker = processes.start(*words, "--slots", "1", "--task", tasks.TOY, "--drain-timeout", 1)
    coordinator.wait_for_event("generation", number=0, level="info")
    coordinator.popen.kill()
    worker.wait_for_event("coordinator gone", run="test")
    assert worker.stop()[0] == 0


@pytest.mark.slow
def test_an_orderly_end_is_not_logged_as_a_loss(processes, small):
    coordinator = processes.coordinator(*small, "--task", tasks.TOY)
    leaves = ("--exit-when-done", "--coordinator-timeout", 1)
    own = processes.worker("--task", tasks.TOY, "--name", "own", *leaves)
    drained = processes.worker("--task", tasks.TOY, "--name", "drained")
    for each in (own, drained):
        each.wait_for_event("joined", run="test")
    coordinator.wait_for_event("generation", number=0)
    drained.popen.terminate()
    assert coordinator.wait_for_event("left")["worker"].startswith("drained/")
    assert "╭─ test · " in printed("status", "test", "--connect", processes.endpoint)
    for verb, event in (("pause", "paused"), ("resume", "resumed"), ("stop", None)):
        assert processes.call(verb, "test", "--connect", processes.endpoint)[0] == 0
        if event:
            coordinator.wait_for_event(event)
    own.wait_for_event("coordinator gone", run="test")
    assert own.finish()[0] == 1, "the run was stopped, and has not ended"


@pytest.mark.slow
def test_the_events_of_a_killed_workers_jobs_are_printed_while_the_run_lives(processes, small):
    coordinator = processes.coordinator(*small)
    worker = processes.worker("--task", tasks.SLOW_TOY, "--name", "host-a")
    coordinator.wait_for_event("generation", number=0)
    worker.popen.kill()
    assert coordinator.wait_for_event("lost")["worker"].startswith("host-a/")

    of_it = ("story", "test", "--connect", processes.endpoint)

    def story(*words):
        return json.loads(printed(*of_it, *words, "--json"))

    while "lost" not in (whats := [each["what"] for each in story("--worker", "host-a")]):
        pass  # a snapshot is a fifth of a second old
    assert whats[0] == "joined"
    assert {"given", "accepted", "reissued"} <= set(whats)
    assert {each["job"].split("/")[1] for each in story("--job", "0/3")} == {"3"}
    assert len(story("--last", "3")) == 3
    code, out, err = call_here(*of_it, "--last", "2")
    assert (code, len(out.splitlines()), " 2 " in err) == (0, 3, True), err
    refused("--job", *of_it, "--job", "three")
    code, _, err = call_here(*of_it, "--worker", "host-b")
    assert (code, "'host-b'" in err, "host-a" in err) == (2, True, True), err


@pytest.mark.slow
def test_a_coordinator_that_answers_with_its_status_alone_is_not_called_absent(processes):
    status = encode_part(snapshot(), "", {}.get)
    with open_session(Network(listen=(processes.endpoint,))) as session:
        key = keys.status("night")
        session.declare_queryable(key, lambda query: query.reply(key, status))
        for run in ((), ("night",)):
            refused("night", "story", *run, "--connect", processes.endpoint, code=1)
    code, _, err = call_here("story", "night", "--connect", processes.endpoint)
    assert (code, "night" in err) == (1, False), err


@pytest.mark.slow
def test_curves_go_on_after_a_kill_and_stall_nothing(processes, small, monkeypatch):
    monkeypatch.setenv("DREAMFLEET_NETWORK_LOG_TO", "tensorboard")
    processes.worker("--task", tasks.TOY)
    board = processes.runs / "test" / "tensorboard"
    judged = ("--evaluate-every", 5, "--evaluation-episodes", 2)
    life = processes.coordinator(*small, "--task", tasks.TOY, *judged)
    monkeypatch.delenv("DREAMFLEET_NETWORK_LOG_TO")  # the run keeps the setting
    for _ in range(2):
        while not any(len(points) > 3 for points in scalars(board).values()):
            life.wait_for_event("generation")
        life.end()
        life = processes.resume()
    life.wait_for_event("generation", times=3)
    life.stop()
    last = processes.resume("test", "--minutes", "0.001")
    assert last.finish()[0] == 0
    with RunFolder(processes.runs / "test") as run:
        wanted = Counter((name.replace("__", "/"), step) for step, each in scalars_of(run) for name in each)
    found = Counter((name, step) for name, points in scalars(board).items() for step, _ in points)
    assert found == wanted


def test_a_follower_that_stands_still_holds_up_no_generation(processes, small, monkeypatch):
    monkeypatch.setenv("DREAMFLEET_NETWORK_LOG_TO", "tensorboard")
    life = processes.coordinator(*small, "--task", tasks.TOY)
    children = Path(f"/proc/{life.popen.pid}/task/{life.popen.pid}/children").read_text().split()
    (follower,) = [int(each) for each in children if "spawn_main" in Path(f"/proc/{each}/cmdline").read_text()]
    os.kill(follower, signal.SIGSTOP)
    processes.worker("--task", tasks.TOY)
    life.wait_for_event("generation", times=20)
    os.kill(follower, signal.SIGKILL)
    life.wait_for_event("curves ended")
    life.wait_for_event("generation", times=2)
