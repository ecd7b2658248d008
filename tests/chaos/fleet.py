"""A real coordinator and real workers that faults are done to; they heal, or are helped as people would help."""

import heapq
import os
import random
import signal
import time
from contextlib import suppress
from itertools import count

import psutil

from dreamfleet.common.errors import JournalError
from dreamfleet.common.runs.run_folder import open_run
from tests.support.relay import Relay

POPULATION, EPISODES = 16, 4
WORKERS = 3
EXCUSE = 12.0  # seconds after a fault that may end a process, in which its end is no failure of ours


class Fleet:
    """A coordinator and workers, each behind a relay of its own; the last one on a host of its own where allowed.

    `runs` and `cache` are the small disks under the runs' folder and the workers' cache, and `clock` is the
    coordinator's, where there are any.
    """

    def __init__(
        self, processes, bundle, generations, seed, task, *settings, host=None, runs=None, cache=None, clock=None
    ):  # fmt: skip
        self.processes, self.host, self.runs, self.cache, self.clock = processes, host, runs, cache, clock
        self.random = random.Random(seed)
        self._task = task
        self._settings = (
            "--listen", processes.endpoint, "--beat", "0.2", "--generations", generations, "--runs-dir", processes.runs,
        )  # fmt: skip
        self._first = (
            "--bundle", bundle, "--task", task, "--population", POPULATION, "--episodes", EPISODES,
            "--evaluate-every", 20, "--evaluation-episodes", 3, *settings,
        )  # fmt: skip
        self._order = count()
        self._healing = []
        self._waiting = set()  # numbers of workers that are to be started again
        self._excused = {}  # until when the end of a worker, by number, or of the coordinator, -1, is no failure
        self._heard = 0  # lines of the coordinator that have been looked at
        self.coordinator = self._coordinate("--run", "run", *self._first)
        self.coordinator.wait_until_serving()
        addresses = ["127.0.0.1"] * WORKERS
        if host:
            addresses[-1] = host.address
        self.relays = [Relay(processes.port, address) for address in addresses]
        self.workers = [self.new_worker(number) for number in range(WORKERS)]

    def _coordinate(self, *words):
        inside = self.clock.inside if self.clock else ()
        return self.processes.start("coordinator", *words, *self._settings, inside=inside)

    def new_worker(self, number):
        inside = self.host.inside if self.host and number == WORKERS - 1 else ()
        return self.processes.worker(
            "--run", "run", "--name", f"w{number}", "--task", self._task,
            endpoint=self.relays[number].endpoint, inside=inside,
        )  # fmt: skip

    def kill_worker(self, number, away):
        """It is gone, and another one of its name comes after so many seconds."""
        kill(self.workers[number])
        self._replace_later(number, away)

    def resume(self):
        self.coordinator = self._coordinate("--resume", "run")
        self._heard = 0

    def kill_coordinator(self):
        kill(self.coordinator)
        self.resume()

    def stop(self, pid, seconds):
        """A process stands still for so long."""
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)
            self.later(seconds, _go_on, pid)

    def excuse(self, *numbers):
        """These workers, or the coordinator (-1), may end by themselves for a while, and are started again."""
        for number in numbers:
            self._excused[number] = time.monotonic() + EXCUSE

    def later(self, seconds, action, *arguments):
        heapq.heappush(self._healing, (time.monotonic() + seconds, next(self._order), action, arguments))

    def heal(self, *, everything=False):
        """Undo the faults whose time has come, and start again what may have ended."""
        while self._healing and (everything or self._healing[0][0] <= time.monotonic()):
            _, _, action, arguments = heapq.heappop(self._healing)
            action(*arguments)
        for number, worker in enumerate(self.workers):
            if worker.popen.poll() is None or number in self._waiting:
                continue
            if not self._is_excused(number):
                raise AssertionError(f"worker {number} ended by itself:\n{''.join(worker.lines[-5:])}")
            self._replace_later(number, 0.0 if everything else 0.5)

    def over(self):
        """Whether the run has ended; one that was paused by a failing job is resumed, as somebody would."""
        lines, self._heard = self.coordinator.lines[self._heard :], len(self.coordinator.lines)
        if any(line.is_event("paused") for line in lines):
            self.later(0.5, self.processes.call, "resume", "run", "--connect", self.processes.endpoint)
        code = self.coordinator.popen.poll()
        if code is None or code == 0:
            return code == 0
        if not self._is_excused(-1):
            raise AssertionError("the coordinator failed:\n" + "".join(self.coordinator.lines[-5:]))
        if self.runs is None or not self.runs.full:
            self.resume()
        return False

    def end(self):
        for disk in filter(None, (self.runs, self.cache)):
            disk.free()
        self.heal(everything=True)
        for relay in self.relays:
            relay.close()

    def _is_excused(self, number):
        return time.monotonic() < self._excused.get(number, 0.0)

    def _replace_later(self, number, seconds):
        self._waiting.add(number)
        self.later(seconds, self._replace, number)

    def _replace(self, number):
        self._waiting.discard(number)
        self.workers[number] = self.new_worker(number)


def kill(process):
    process.thaw()
    process.popen.kill()
    process.popen.wait()


def children(process):
    """Process ids of a worker's slots."""
    with suppress(psutil.NoSuchProcess):
        return [each.pid for each in psutil.Process(process.popen.pid).children()]
    return []


def accepted(processes):
    """Results in the journal, as somebody else reads it."""
    try:
        with open_run(processes.runs, "run") as run:
            return run.result_count()
    except JournalError:
        return 0


def _go_on(pid):
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)
