"""What the page remembers of live runs."""

import json
import time
from types import SimpleNamespace

from dreamfleet.common.network import Network
from dreamfleet.coordinator.dashboard import watching
from dreamfleet.coordinator.dashboard.lanes import STRETCH, UNKNOWN
from tests.support.processes import free_port
from tests.support.served import serving, snapshot


def test_what_workers_did_is_remembered_while_nobody_looks(tmp_path, monkeypatch):
    now = [1000.0]
    monkeypatch.setattr(watching, "time", SimpleNamespace(time=lambda: now[0], monotonic=time.monotonic))
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    watcher = watching.Watcher(Network(connect=(endpoint,)), None, tmp_path)

    def lane():
        while (shown := watcher.look().of("night")) is None:
            pass  # a busy host may answer late
        _, data = shown.frame.decode().split("data: ")
        return json.loads(data)["workers"]["lane"][0]

    with serving(endpoint, snapshot(4, workers=1)):
        seen = lane()[-1]
        for _ in range(2):
            watcher.rest()
        now[0] += 3 * STRETCH
        assert lane()[-4:] == seen + 2 * UNKNOWN + seen
        watcher.rest()
