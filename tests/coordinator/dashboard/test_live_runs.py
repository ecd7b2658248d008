"""The state that the page keeps of live runs."""

import json
import time
from types import SimpleNamespace

from dreamfleet.common.transport.network import Network
from dreamfleet.coordinator.dashboard import live_runs
from dreamfleet.coordinator.dashboard.lanes import STRETCH, UNKNOWN
from tests.support.processes import free_port
from tests.support.served import serving, snapshot


def test_lanes_are_kept_while_polling_is_suspended(tmp_path, monkeypatch):
    now = [1000.0]
    monkeypatch.setattr(live_runs, "time", SimpleNamespace(time=lambda: now[0], monotonic=time.monotonic))
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    watcher = live_runs.Watcher(Network(connect=(endpoint,)), None, tmp_path)

    def lane():
        while (shown := watcher.poll().find("night")) is None:
            pass  # a busy host may answer late
        _, data = shown.page_state.decode().split("data: ")
        return json.loads(data)["workers"]["lane"][0]

    with serving(endpoint, snapshot(4, workers=1)):
        seen = lane()[-1]
        for _ in range(2):
            watcher.suspend()
        now[0] += 3 * STRETCH
        assert lane()[-4:] == seen + 2 * UNKNOWN + seen
        watcher.suspend()


def test_a_run_by_name_is_followed_among_more_runs_than_the_page_holds(tmp_path, monkeypatch):
    monkeypatch.setattr(live_runs, "MOST_RUNS", 1)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    watcher = live_runs.Watcher(Network(connect=(endpoint,)), "night", tmp_path)
    with serving(endpoint, snapshot(4), snapshot(4, name="day")):
        while watcher.poll().find("night") is None:
            pass  # a busy host may answer late
        assert watcher.poll().find("day") is None
