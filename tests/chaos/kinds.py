"""Every kind of fault: how often it comes, and what it does to a fleet. What it needs to be undone comes by itself."""

import os
import shutil
import signal
from contextlib import suppress
from pathlib import Path

from tests.chaos.fleet import WORKERS, children, kill
from tests.support import tasks

EVERYBODY = range(WORKERS)


KINDS = {}  # each takes the fleet and the number of a worker


def kind(often, possible=lambda _fleet: True):
    """A kind that comes so `often`; `possible` says whether this machine can do it to a fleet."""

    def register(strike):
        KINDS[strike.__name__] = strike
        strike.often, strike.possible = often, possible
        return strike

    return register


# Processes.


@kind(often=4)
def kill_worker(fleet, number):
    fleet.kill_worker(number, away=fleet.random.uniform(0, 1))


@kind(often=2)
def kill_slot(fleet, number):
    """A simulator crashes: the job that it had fails there, and another worker tries."""
    for pid in children(fleet.workers[number])[-1:]:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


@kind(often=3)
def stop_worker(fleet, number):
    fleet.stop(fleet.workers[number].popen.pid, fleet.random.uniform(0.2, 4))


@kind(often=2)
def stopped_start(fleet, number):
    """A worker, or its child, stands still as it starts."""
    fleet.kill_worker(number, away=0.0)
    seconds, child = fleet.random.uniform(0.2, 3), fleet.random.random() < 0.5
    fleet.later(fleet.random.uniform(0, 1.5), _stop_as_it_starts, fleet, number, seconds, child)


def _stop_as_it_starts(fleet, number, seconds, child):
    worker = fleet.workers[number]
    for pid in children(worker)[-1:] if child else [worker.popen.pid]:
        fleet.stop(pid, seconds)


@kind(often=1)
def double_name(fleet, number):
    """Somebody starts another worker of the same name, for a while."""
    double = fleet.new_worker(number)
    fleet.later(fleet.random.uniform(1, 4), kill, double)


@kind(often=1)
def leave(fleet, number):
    """A worker is stopped in order: it finishes what it has."""
    fleet.excuse(number)
    fleet.workers[number].popen.terminate()


@kind(often=2)
def kill_coordinator(fleet, _number):
    fleet.kill_coordinator()


@kind(often=1)
def restarts_in_a_row(fleet, _number):
    """Killed three times within a second, as it starts too."""
    fleet.kill_coordinator()
    for seconds in (0.3, 0.7):
        fleet.later(seconds, fleet.kill_coordinator)


@kind(often=1)
def stop_coordinator(fleet, _number):
    fleet.stop(fleet.coordinator.popen.pid, fleet.random.uniform(0.2, 3))


@kind(often=1)
def frozen_pipe(fleet, number):
    """Nobody reads what a process logs, and its pipe is small."""
    process = fleet.coordinator if fleet.random.random() < 0.7 else fleet.workers[number]
    if process.popen.poll() is None:
        process.freeze()
        fleet.later(fleet.random.uniform(1, 4), process.thaw)


# The network.


@kind(often=3)
def cut(fleet, number):
    fleet.relays[number].cut()


@kind(often=2)
def hold(fleet, number):
    fleet.relays[number].hold()
    fleet.later(fleet.random.uniform(0.2, 4), fleet.relays[number].release)


@kind(often=1, possible=lambda fleet: fleet.clock is not None)
def outage(fleet, _number):
    """All links, for longer than the coordinator waits for a silent worker."""
    for relay in fleet.relays:
        relay.hold()
        fleet.later(30, relay.release)


@kind(often=1)
def late_link(fleet, number):
    fleet.relays[number].delay = fleet.random.choice([0.0, 0.02, 0.1])


@kind(often=2)
def slow_link(fleet, number):
    """A few kilobytes a second, for a while."""
    fleet.relays[number].rate = fleet.random.choice([8e3, 3e4, 1e5])
    fleet.later(fleet.random.uniform(1, 4), setattr, fleet.relays[number], "rate", 0.0)


@kind(often=2, possible=lambda fleet: fleet.host is not None)
def unplug(fleet, _number):
    fleet.host.unplug()
    fleet.later(fleet.random.uniform(0.2, 6), fleet.host.plug)


@kind(often=1, possible=lambda fleet: fleet.clock is not None)
def clock_step(fleet, _number):
    """The coordinator's wall clock is set."""
    fleet.clock.set(fleet.random.choice((-172_800, -3_600, 3_600, 86_400)))


# Disks and files.


@kind(often=1, possible=lambda fleet: fleet.runs is not None)
def full_runs(fleet, _number):
    """The journal's disk is full: the coordinator says so and ends; somebody makes room and resumes."""
    fleet.excuse(-1)
    fleet.runs.fill()
    fleet.later(fleet.random.uniform(0.3, 2), fleet.runs.free)


@kind(often=1, possible=lambda fleet: fleet.cache is not None)
def full_cache(fleet, number):
    """A worker must fetch the bundle, and has no room for it."""
    fleet.excuse(*EVERYBODY)
    for path in _cached(fleet):
        path.unlink()
    fleet.cache.fill()
    fleet.kill_worker(number, away=0.0)
    fleet.later(fleet.random.uniform(0.5, 3), fleet.cache.free)


@kind(often=1)
def damaged_cache(fleet, number):
    """The cached bundle is damaged, and a child that begins anew meets it."""
    for path in _cached(fleet):
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        _exchange(path, data)
    _begin_anew(fleet, number)


@kind(often=1)
def swapped_cache(fleet, number):
    """The cached bundle is another valid one, which gives other fitnesses."""
    other = fleet.processes.folder / "other.zip"
    for path in _cached(fleet):
        _exchange(path, other.read_bytes())
    _begin_anew(fleet, number)


def _cached(fleet):
    return list((fleet.processes.cache / "bundles").glob("*.zip"))


def _exchange(path, data):
    """At once, as a program that writes aside would: who reads the old file goes on reading that."""
    aside = path.with_suffix(".aside")
    try:
        aside.write_bytes(data)
        shutil.move(aside, path)
    except OSError:  # the disk is full
        aside.unlink(missing_ok=True)


def _begin_anew(fleet, number):
    """A child at once; the worker, which looks whether the cache is whole, soon."""
    fleet.excuse(*EVERYBODY)
    kill_slot(fleet, number)
    fleet.later(fleet.random.uniform(3, 6), fleet.kill_worker, number, 0.0)


# Numbers.


@kind(often=2)
def odd_reward(fleet, _number):
    """One episode somewhere gives no number: it is refused with its reason, and driven again elsewhere."""
    _ask_for_reward(fleet.random.choice(("inf", "-inf", "nan")))


@kind(often=1)
def huge_reward(_fleet, _number):
    """One episode gives 1e308, which is a number that no mean can hold."""
    _ask_for_reward("1e307")


def _ask_for_reward(number):
    path = Path(os.environ[tasks.ODD_REWARD])
    aside = path.with_suffix(".aside")
    aside.write_text(number)
    aside.replace(path)
