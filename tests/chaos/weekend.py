"""A weekend with nobody watching, compressed: the run ends by itself, with the bits of one that nothing disturbed.

    make weekend MINUTES=60 SEED=1

The environment gives NaN, raises, crashes after a fork and hangs, by its parameters and seeds. Links are cut for 30 s,
the coordinator, workers and slots are killed or stopped, workers leave, the coordinator's wall clock is set, and its
disk is full for a minute. Supervisors start again what ends with an error, as systemd does. Prints one line of JSON.
"""

import argparse
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack, suppress
from pathlib import Path

from dreamfleet.common.runs.run_folder import open_run
from tests.chaos.fleet import children, kill
from tests.support import same_bits
from tests.support.disks import small_disk
from tests.support.processes import processes_in
from tests.support.relay import Relay
from tests.support.wall_clock import WallClock
from tests.support.weekend_world import STEP_SECONDS

TASK = "gym:tests.support.weekend_world:Weekend-v0"
RUN = "weekend"
WORKERS, SLOTS = 3, 2
RUNS_DISK = 200  # megabytes
RESTART = 5.0  # seconds at least between two starts of a coordinator
CALM = 900.0  # seconds without a new result that mean a hung run
SETTINGS = {
    "task": TASK, "population": 16, "episodes": 2, "evaluate-every": 10, "evaluation-episodes": 8,
    "confirm-episodes": 16, "on-failure": "worst",
}  # fmt: skip


class Weekend:
    """A supervised fleet, and what is done to it."""

    def __init__(self, processes, generations, seed, disk, step):
        self.random = random.Random(seed)
        self.happened = Counter()
        self.restarts = Counter()
        self._restart_at = 0.0  # of the coordinator
        self._processes, self._disk = processes, disk
        self._clock = WallClock(processes.folder / "clock") if WallClock.possible() else None
        self._step = step
        self._limits = ("--generations", generations, "--listen", processes.endpoint, "--runs-dir", processes.runs,
                        "--beat", "0.5")  # fmt: skip
        flags = [text for name, value in SETTINGS.items() for text in (f"--{name}", value)]
        self.coordinator = self._coordinate("--run", RUN, *flags)
        self.coordinator.wait_until_serving()
        self.relays = [Relay(processes.port) for _ in range(WORKERS)]
        self.workers = [self._work(number) for number in range(WORKERS)]
        self._later = []  # (when, action)

    def _coordinate(self, *arguments):
        inside = () if self._clock is None else self._clock.inside
        return self._processes.start("coordinator", *arguments, *self._limits, inside=inside)

    def _work(self, number):
        return self._processes.start(
            "worker", "--connect", self.relays[number].endpoint, "--slots", SLOTS, "--run", RUN, "--name",
            f"host{number}", "--task", TASK, "--exit-when-done", inside=("env", f"{STEP_SECONDS}={self._step}"),
        )  # fmt: skip

    def supervise(self):
        """Start again what ended with an error; whether the run has ended by itself."""
        now = time.monotonic()
        for each in [each for each in self._later if each[0] <= now]:
            self._later.remove(each)
            each[1]()
        code = self.coordinator.popen.poll()
        if code not in (None, 0) and now >= self._restart_at:
            self._restart_at = now + RESTART
            self.restarts["coordinator"] += 1
            self.coordinator = self._coordinate("--resume", RUN)
        for number, worker in enumerate(self.workers):
            if (ended := worker.popen.poll()) == 0 and code is None and not self._has_ended():
                raise AssertionError(f"worker {number} left a run that goes on:\n{''.join(worker.lines[-5:])}")
            if ended not in (None, 0):
                self.restarts["worker"] += 1
                self.workers[number] = self._work(number)
        return code == 0

    def _has_ended(self):
        with open_run(self._processes.runs, RUN) as run:
            return run.ended is not None

    def strike(self):
        """One of the faults, or none of the kinds that this machine cannot do; seconds until it is healed."""
        kinds = ["link", "links", "coordinator", "worker", "slot", "stopped worker", "stopped coordinator", "leave"]
        kinds += ["full disk"] * (self._disk is not None) + ["clock step"] * (self._clock is not None)
        fewest = min(self.happened[each] for each in kinds)
        kind = self.random.choice([each for each in kinds if self.happened[each] == fewest])
        self.happened[kind] += 1
        return getattr(self, f"_{kind.replace(' ', '_')}")(self.random.randrange(WORKERS))

    def _link(self, number):
        self.relays[number].hold()
        self.after(30, self.relays[number].release)
        return 30

    def _links(self, _number):
        return max(self._link(number) for number in range(WORKERS))

    def _coordinator(self, _number):
        kill(self.coordinator)
        return 5

    def _worker(self, number):
        kill(self.workers[number])
        return 5

    def _slot(self, number):
        for pid in children(self.workers[number])[:1]:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return 2

    def _stopped_worker(self, number):
        return self._stop(self.workers[number].popen.pid, 20)

    def _stopped_coordinator(self, _number):
        return self._stop(self.coordinator.popen.pid, 10)

    def _stop(self, pid, seconds):
        os.kill(pid, signal.SIGSTOP)
        self.after(seconds, lambda: os.kill(pid, signal.SIGCONT))
        return seconds

    def _leave(self, number):
        worker = self.workers[number]
        worker.popen.send_signal(signal.SIGTERM)
        worker.finish()
        self.workers[number] = self._work(number)
        return 2

    def _full_disk(self, _number):
        """SQLite may go on for a while in its log's old room; a coordinator that begins needs new room."""
        self._disk.fill()
        self.after(20, lambda: kill(self.coordinator))
        self.after(60, self._disk.free)
        return 60

    def _clock_step(self, _number):
        self._clock.set(self.random.choice((-172_800, -3_600, 3_600, 86_400)))
        return 1

    def after(self, seconds, action):
        self._later.append((time.monotonic() + seconds, action))

    def heal(self):
        """Undo everything that waits."""
        for _, action in self._later:
            with suppress(OSError):
                action()
        self._later = []


def drive(processes, generations, seed, step, pause):
    """Run to the end, with a fault every `pause` seconds (0: none); what came of it."""
    with ExitStack() as stack:
        disk = stack.enter_context(small_disk(processes.runs, RUNS_DISK))
        weekend = Weekend(processes, generations, seed, disk if pause else None, step)
        stack.callback(processes.end)  # before the disk goes
        stack.callback(weekend.heal)
        results, moved, next_fault = 0, time.monotonic(), time.monotonic() + pause
        while not weekend.supervise():
            time.sleep(0.2)
            now = time.monotonic()
            if pause and now >= next_fault:
                next_fault = now + weekend.strike() + pause * weekend.random.uniform(0.5, 1.5)
                print(f"{results} results, {dict(weekend.happened)}", file=sys.stderr, flush=True)
            if (found := _results(processes)) > results:
                results, moved = found, now
            if now - moved > CALM:
                raise AssertionError(f"no result for {CALM:g} s; faults so far: {weekend.happened}")
        weekend.heal()
        exits = [worker.finish()[0] for worker in weekend.workers]
        return outcome(processes, generations), weekend.happened, weekend.restarts, exits


def _results(processes):
    with open_run(processes.runs, RUN) as run:
        return run.result_count()


def outcome(processes, generations):
    """What the run computed, without times; its story, and how many results are missing."""
    computed = same_bits.outcome(processes, RUN)._asdict()
    with open_run(processes.runs, RUN) as run:
        computed["statistics"] = [(each.std, each.best, each.worst, each.failed) for each in run.history()]
        computed["failed"] = sorted({(each.generation, each.candidate) for each in run.failures()
                                     if each.kind == "score"})  # fmt: skip
        scored = [each for each, fitness in zip(computed["episodes"], computed["fitness"], strict=True)
                  if fitness is not None]  # fmt: skip
        lost = sum(2 - len(each) for each in scored) + 16 * generations - len(computed["fitness"])
        return computed, lost, run.events(), Counter(each.cause for each in run.failures())


def is_reported(story, happened, restarts):
    """For each kind of fault: whether the story has at least as many events as there were faults."""
    counts = Counter(each.what for each in story)
    gone = counts["lost"] + counts["silent"] + counts["left"]
    cuts = happened["link"] + happened["links"] + happened["worker"] + happened["leave"] + happened["stopped worker"]
    return {
        "coordinator": len({each.incarnation for each in story}) >= 1 + happened["coordinator"] + happened["full disk"],
        "clock step": counts["clock"] >= happened["clock step"] - happened["coordinator"],
        "workers": gone >= cuts // 2,
        "restarts": sum(restarts.values()) >= happened["coordinator"] + happened["worker"],
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="about how long the disturbed run takes")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--step", type=float, default=0.1, help="seconds of a step in the disturbed run")
    parser.add_argument("--pause", type=float, default=25.0, help="seconds between two faults")
    parser.add_argument("--folder", type=Path, help="a new folder, which is kept")
    args = parser.parse_args()
    seconds = 16 * 2 * 20 * args.step / (WORKERS * SLOTS)  # of a generation without faults
    generations = max(2, int(args.minutes * 60 * 0.6 / seconds))
    with ExitStack() as stack:
        folder = args.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        outcomes = []
        for name, step, pause in (("calm", 0.0, 0.0), ("weekend", args.step, args.pause)):
            (folder / name).mkdir(parents=True)
            started = time.monotonic()
            with processes_in(folder / name) as processes:
                outcomes.append(drive(processes, generations, args.seed, step, pause))
            print(f"{name}: {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)
    (calm, *_), (found, happened, restarts, exits) = outcomes
    different = [name for name in calm[0] if calm[0][name] != found[0][name]]
    figures = {
        "identical": not different, "different": different, "lost": found[1], "generations": generations,
        "failed_candidates": len(found[0]["failed"]), "causes": dict(found[3]), "faults": dict(happened),
        "restarts": dict(restarts), "worker_exits": exits, "reported": is_reported(found[2], happened, restarts),
        "seconds": round(time.monotonic() - started),
    }  # fmt: skip
    print(json.dumps(figures))
    return 0 if not different and not found[1] and not any(exits) and all(figures["reported"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
