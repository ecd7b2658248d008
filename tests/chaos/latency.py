"""How soon a fleet goes on after each kind of loss, in seconds: what its log and its journal show.

python -m tests.chaos.latency
"""

import json
import os
import signal
import statistics
import sys
import tempfile
import time
from pathlib import Path

from tests.chaos.fleet import POPULATION, Fleet, accepted
from tests.support import tasks
from tests.support.bundles import write_random_bundle
from tests.support.processes import processes_in

ROUNDS = 5


def until_said(fleet, event):
    started = time.monotonic()
    fleet.coordinator.wait_for_event(event)
    return time.monotonic() - started


def until_result(processes):
    started, before = time.monotonic(), accepted(processes)
    while accepted(processes) == before:
        time.sleep(0.002)
    return time.monotonic() - started


def measure(folder):
    os.environ[tasks.STEPS_FOLDER] = str(folder)
    figures = {"killed_worker": [], "stopped_worker": [], "coordinator_start": [], "killed_coordinator": []}
    bundle = write_random_bundle(folder / "random.zip").path
    with processes_in(folder / "fleet") as processes:
        fleet = Fleet(processes, bundle, generations=10**6, seed=1, task=tasks.COUNTED)
        fleet.coordinator.wait_for_event("generation", number=3)
        for _ in range(ROUNDS):
            fleet.workers[0].popen.kill()
            figures["killed_worker"].append(until_said(fleet, "lost"))
            fleet.workers[0] = fleet.new_worker(0)
            fleet.coordinator.wait_for_event("generation", times=100)
            os.kill(fleet.workers[1].popen.pid, signal.SIGSTOP)
            figures["stopped_worker"].append(until_said(fleet, "silent"))
            os.kill(fleet.workers[1].popen.pid, signal.SIGCONT)
            fleet.coordinator.wait_for_event("generation", times=20)
            fleet.coordinator.popen.kill()
            fleet.coordinator.popen.wait()
            fleet.resume()
            figures["coordinator_start"].append(until_said(fleet, "begin"))
            figures["killed_coordinator"].append(until_result(processes))
            fleet.coordinator.wait_for_event("generation", times=20)
        fleet.end()
    return {name: round(statistics.median(values), 3) for name, values in figures.items()}


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        print(json.dumps({**measure(Path(name)), "population": POPULATION, "rounds": ROUNDS}), file=sys.stdout)
