"""A real fleet whose parts are killed, stopped, cut off and restarted, and one that nobody disturbs: the same bits?

    make chaos FAULTS=200 SEED=7

Faults come from the seed, each after at least 50 more accepted results than the one before. Prints one line of JSON:
whether every fitness, vector and the mean are equal, jobs lost, and the share of environment steps that did not count.
"""

import argparse
import heapq
import json
import os
import random
import signal
import sys
import tempfile
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np

from dreamfleet.common.errors import JournalError
from dreamfleet.common.runs import open_run
from tests.support import tasks
from tests.support.bundles import write_random_bundle
from tests.support.hosts import new_host
from tests.support.processes import processes_in
from tests.support.relay import Relay

POPULATION, EPISODES = 16, 4
JOBS_A_FAULT = 50
WORKERS = 3
CALM = 120.0  # seconds without a new result that mean a hung run


class Fleet:
    """A coordinator and workers, each behind a relay of its own; the last one on a host of its own where allowed."""

    def __init__(self, processes, bundle, generations, seed, host=None):
        self.processes = processes
        self._host = host
        self.random = random.Random(seed)
        self._settings = (
            "--listen", processes.endpoint, "--beat", "0.2", "--generations", generations, "--runs-dir", processes.runs,
        )  # fmt: skip
        self._first = (
            "--bundle", bundle, "--task", tasks.COUNTED, "--population", POPULATION, "--episodes", EPISODES,
            "--evaluate-every", 20, "--evaluation-episodes", 3,
        )  # fmt: skip
        self.coordinator = processes.start("coordinator", "--run", "run", *self._settings, *self._first)
        self.coordinator.wait_for("incarnation")
        addresses = ["127.0.0.1"] * WORKERS
        if host:
            addresses[-1] = host.address
        self.relays = [Relay(processes.port, address) for address in addresses]
        self.workers = [self._new_worker(number) for number in range(WORKERS)]
        self._healing = []
        self.faults = dict.fromkeys(self.kinds(), 0)

    def _new_worker(self, number):
        inside = self._host.inside if self._host and number == WORKERS - 1 else ()
        return self.processes.worker(
            "--run", "run", "--name", f"w{number}", "--task", tasks.COUNTED,
            endpoint=self.relays[number].endpoint, inside=inside,
        )  # fmt: skip

    def kinds(self):
        """Of faults, and how often each comes."""
        often = {
            "kill_worker": 4, "stop_worker": 3, "cut": 3, "hold": 2, "slow": 1, "kill_coordinator": 2,
            "stop_coordinator": 1,
        }  # fmt: skip
        return often | ({"unplug": 2} if self._host else {})

    def disturb(self):
        """One fault; what it needs to be undone comes later by itself."""
        kind = self.random.choices(*zip(*self.kinds().items(), strict=True))[0]
        number = self.random.randrange(WORKERS)
        getattr(self, kind)(number)
        self.faults[kind] += 1

    def kill_worker(self, number):
        old = self.workers[number]
        old.popen.kill()
        old.popen.wait()
        self._later(self.random.uniform(0, 1), self._replace, number)

    def _replace(self, number):
        self.workers[number] = self._new_worker(number)

    def stop_worker(self, number):
        self._stop(self.workers[number].popen, self.random.uniform(0.2, 4))

    def stop_coordinator(self, _number):
        self._stop(self.coordinator.popen, self.random.uniform(0.2, 3))

    def _stop(self, process, seconds):
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGSTOP)
            self._later(seconds, self._go_on, process)

    def _go_on(self, process):
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGCONT)

    def cut(self, number):
        self.relays[number].cut()

    def hold(self, number):
        self.relays[number].hold()
        self._later(self.random.uniform(0.2, 4), self.relays[number].release)

    def slow(self, number):
        self.relays[number].delay = self.random.choice([0.0, 0.02, 0.1])

    def unplug(self, _number):
        self._host.unplug()
        self._later(self.random.uniform(0.2, 6), self._host.plug)

    def kill_coordinator(self, _number):
        self.coordinator.popen.kill()
        self.coordinator.popen.wait()
        self.resume()

    def resume(self):
        self.coordinator = self.processes.start("coordinator", "--resume", "run", *self._settings)

    def _later(self, seconds, action, *arguments):
        heapq.heappush(self._healing, (time.monotonic() + seconds, id(action), action, arguments))

    def heal(self, *, everything=False):
        """Undo the faults whose time has come."""
        while self._healing and (everything or self._healing[0][0] <= time.monotonic()):
            _, _, action, arguments = heapq.heappop(self._healing)
            action(*arguments)
        for number, worker in enumerate(self.workers):
            waiting = any(action == self._replace and what == (number,) for _, _, action, what in self._healing)
            if worker.popen.poll() is not None and not waiting:
                raise AssertionError(f"worker {number} ended by itself:\n{''.join(worker.lines[-5:])}")

    def end(self):
        self.heal(everything=True)
        for relay in self.relays:
            relay.close()


def accepted(processes):
    """Results in the journal, as somebody else reads it."""
    try:
        with open_run(processes.runs, "run") as run:
            return run.result_count()
    except JournalError:
        return 0


def drive(processes, bundle, generations, faults, seed):
    """Run to the end under `faults` faults; what happened."""
    with new_host() as host:
        fleet = Fleet(processes, bundle, generations, seed, host)
        return _drive(fleet, processes, faults)


def _drive(fleet, processes, faults):
    done = next_fault = 0
    moved = time.monotonic()
    try:
        while fleet.coordinator.popen.poll() is None:
            time.sleep(0.05)
            fleet.heal()
            now_done = accepted(processes)
            if now_done > done:
                done, moved = now_done, time.monotonic()
            if time.monotonic() - moved > CALM:
                raise AssertionError(f"no result for {CALM:g} s at {done} results; faults so far: {fleet.faults}")
            if sum(fleet.faults.values()) < faults and done >= next_fault:
                next_fault = done + JOBS_A_FAULT
                fleet.disturb()
                if sum(fleet.faults.values()) % 20 == 0:
                    print(f"{sum(fleet.faults.values())} faults, {done} results", file=sys.stderr, flush=True)
        if fleet.coordinator.popen.returncode != 0:
            raise AssertionError("the coordinator failed:\n" + "".join(fleet.coordinator.lines[-5:]))
    finally:
        fleet.end()
    return fleet.faults


def outcome(processes, generations):
    """Every fitness and vector, every evaluation, and the reported mean."""
    with open_run(processes.runs, "run") as run:
        places = [(g, i) for g in range(generations) for i in range(POPULATION)]
        fitness = [run.fitness(*place) for place in places]
        episodes = [[(each.seed, each.fitness, each.steps) for each in run.results(*place)] for place in places]
        vectors = [run.candidate(*place).tobytes() for place in places]
        mean = np.load(run.controller_path)["parameters"].tobytes()
        lost = sum(EPISODES - len(each) for each in episodes)
        return (fitness, episodes, vectors, run.evaluations(), mean), lost


def compare(folder, faults, seed):
    """Both fleets; the figures."""
    generations = faults * JOBS_A_FAULT // (POPULATION * EPISODES) + 4
    outcomes = []
    for name, count in (("calm", 0), ("chaos", faults)):
        steps = folder / name / "steps"
        steps.mkdir(parents=True)
        os.environ[tasks.STEPS_FOLDER] = str(steps)
        bundle = write_random_bundle(folder / name / "random.zip").path
        started = time.monotonic()
        with processes_in(folder / name) as processes:
            happened = drive(processes, bundle, generations, count, seed)
            whole, lost = outcome(processes, generations)
            outcomes.append(whole)
            made, counted = tasks.steps_made(steps), 10 * accepted(processes)
        print(f"{name}: {time.monotonic() - started:.0f} s, {made} steps made, {counted} counted", file=sys.stderr)
    calm, chaos = outcomes
    return {
        "identical": calm == chaos,
        "lost": lost,
        "waste": round(1 - counted / made, 4),
        "faults": happened,
        "jobs": counted // 10,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--seed", type=int, default=7)
    arguments = parser.parse_args()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        figures = compare(folder, arguments.faults, arguments.seed)
    print(json.dumps(figures))
    return 0 if figures["identical"] and not figures["lost"] else 1


if __name__ == "__main__":
    sys.exit(main())
