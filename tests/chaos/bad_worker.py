"""Generations a second of one good worker alone, and with a bad one beside it, in blocks that take turns.

python -m tests.chaos.bad_worker --json
"""

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

from dreamfleet.common.client.client import Client
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.worker.addons.bench.sleep_tasks import SLEEP_TASK
from tests.support.bundles import write_random_bundle
from tests.support.hosts import new_host
from tests.support.processes import processes_in, until

NAPPING = ("--task", SLEEP_TASK, "--population", "8", "--episodes", "2")  # 16 naps of 50 ms
DREAMING = ("--preset", "dream", "--population", "16", "--episodes", "4", "--horizon", "200")
BADS = ("slow_link", "slow_core", "flapping")
BLOCKS, SECONDS, SETTLING = 5, 20.0, 6.0
LIFE = 6  # seconds of a flapping host: it joins after about three
TBF = ("root", "tbf", "rate", "256kbit", "burst", "4kb", "latency", "2s")


class Bench:
    """A coordinator that never ends, a good worker on a core of its own, and what may be added to it."""

    def __init__(self, processes, bundle, settings, host, tasks):
        self._processes, self._host, self._tasks = processes, host, tasks
        near = f"tcp/{host.address}:{processes.port}"
        self._near = near
        at = ("--listen", processes.endpoint, near, "--insecure")
        processes.coordinator("--bundle", bundle, "--evaluate-every", 0, *settings, "--beat", 1, name="run", at=at)
        self.good = self.worker("good", inside=("taskset", "-c", "0"))
        until(lambda: self._closed() > 2, "three generations are closed")

    def worker(self, name, **more):
        return self._processes.worker("--run", "run", "--name", name, *self._tasks, **more)

    def rate(self):
        """Generations a second."""
        before, started = self._closed(), time.monotonic()
        time.sleep(SECONDS)
        return (self._closed() - before) / (time.monotonic() - started)

    def _closed(self):
        with open_run(self._processes.runs, "run") as run:
            return len(run.history())

    def _until_joined(self):
        until(lambda: any(each.state == "present" for each in self._workers("bad/")), "the bad worker joins")

    def _workers(self, name):
        with Client((self._processes.endpoint,)) as client:
            return [each for each in client.workers("run") if each.worker.startswith(name)]

    @contextmanager
    def slow_link(self):
        device = f"{self._host.name}-a"
        for inside, end in (((), device), (self._host.inside, f"{self._host.name}-b")):
            subprocess.run([*inside, "tc", "qdisc", "replace", "dev", end, *TBF], check=True)
        with _ending(self.worker("bad", endpoint=self._near, inside=self._host.inside)):
            self._until_joined()
            yield

    @contextmanager
    def slow_core(self):
        with _ending(self.worker("bad", inside=("taskset", "-c", "1", "chrt", "--idle", "0"))):
            self._until_joined()
            yield

    @contextmanager
    def flapping(self):
        again = ("sh", "-c", f'while true; do timeout -s KILL {LIFE} "$@"; done', "sh")
        with _ending(self.worker("bad", inside=again)):
            self._until_joined()
            yield

    def finished(self):
        """Jobs that the bad one has brought back in this life."""
        return sum(each.finished for each in self._workers("bad/"))


@contextmanager
def busy_core(busy):
    """Core 1 is busy all the time, in both kinds of blocks: what it costs the coordinator is not the worker's doing."""
    process = subprocess.Popen(["taskset", "-c", "1", sys.executable, "-c", "while True: pass"]) if busy else None
    try:
        yield
    finally:
        if process is not None:
            process.kill()
            process.wait()


@contextmanager
def _ending(process):
    try:
        yield process
    finally:
        os.killpg(process.popen.pid, signal.SIGKILL)
        process.popen.wait()
        time.sleep(1.0)


def measure(folder, dreaming):
    """The medians of each kind, and their ratio: how many times slower a generation becomes."""
    figures = {}
    settings, tasks = (DREAMING, ()) if dreaming else (NAPPING, ("--task", SLEEP_TASK))
    bundle = write_random_bundle(folder / "random.zip").path
    for kind in BADS:
        with new_host() as host, processes_in(folder / kind) as processes, busy_core(kind == "slow_core"):
            bench = Bench(processes, bundle, settings, host, tasks)
            alone, both, brought = [], [], []
            for _ in range(BLOCKS):
                alone.append(bench.rate())
                with getattr(bench, kind)():
                    time.sleep(SETTLING)
                    both.append(bench.rate())
                    brought.append(bench.finished())
        pair = statistics.median(alone), statistics.median(both)
        figures[kind] = {"alone": round(pair[0], 3), "both": round(pair[1], 3), "ratio": round(pair[0] / pair[1], 3),
                         "brought": brought}  # fmt: skip
        print(kind, figures[kind], file=sys.stderr, flush=True)
    return figures


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--dream", action="store_true", help="a real dream run, in place of naps")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        figures = measure(Path(name), arguments.dream)
    if arguments.json:
        print(json.dumps(figures))
    return 0 if all(each["ratio"] <= 1.05 for each in figures.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
