"""A slot with a real child, and the events that it sends."""

import os
import queue
import signal
from contextlib import suppress
from functools import cache
from time import monotonic

from msgspec.structs import replace

from dreamfleet.common.artifacts.bundle import hash_file
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.service.child import ScorerArguments
from dreamfleet.worker.service.slot import MAX_STARVED_DELAY, Slot
from tests.support import tasks
from tests.support.processes import DEADLINE
from tests.support.samples import VECTOR, job


@cache
def hash_of(bundle):
    return hash_file(bundle)


def spec(task, bundle):
    return TaskSpec(task=task, bundle=hash_of(bundle), horizon=100, patience=0)


class Harness:
    """A slot and its worker's queue."""

    def __init__(self, task, bundle, memory_limit=0, **more):
        self.spec = spec(task, bundle)
        self.events = queue.SimpleQueue()
        arguments = ScorerArguments(self.spec, bundle, (*tasks.ALL, task))
        self.slot = Slot(0, arguments, self.events, memory_limit, **more)

    def pass_time(self):
        """The longest pause before a start, in no time."""
        self.slot.check(monotonic() + MAX_STARVED_DELAY + 1.0, 0.0)

    def wait_ready(self):
        while not self.slot.ready:
            self.take()
        return self

    def take(self):
        """What the slot's next event brings; as a worker does, it looks at the slot often, and starts a child."""
        until = monotonic() + DEADLINE
        while monotonic() < until:
            self.slot.check(monotonic(), 0.0)
            if self.slot.pid == 0:
                self.pass_time()
            with suppress(queue.Empty):
                return self.slot.handle(self.events.get(timeout=0.05)[1])
        raise AssertionError("no event")

    def results(self):
        while not (results := self.take()):
            pass
        return results

    def result(self):
        (result,) = self.results()
        return result

    def outcome(self):
        """The result, and the file that came with it."""
        while True:
            event = self.events.get(timeout=DEADLINE)[1]
            if results := self.slot.handle(event):
                return results[0], event.upload

    def submit(self, *numbers, kind="score"):
        """Groups of one job each."""
        for number in numbers:
            self.slot.submit([(job(number, kind, spec=self.spec), VECTOR)])

    def submit_group(self, numbers):
        """One group of these jobs, which are returned."""
        jobs = [job(number, spec=self.spec) for number in numbers]
        self.slot.submit([(each, VECTOR) for each in jobs])
        return jobs

    def lose(self):
        """Kill the child, and handle that it is gone."""
        os.kill(self.slot.pid, signal.SIGKILL)
        self.slot.handle(self.gone())

    def gone(self):
        """The event that the child is gone, not handled yet."""
        while (event := self.events.get(timeout=DEADLINE)[1]).message is not None:
            self.slot.handle(event)
        return event

    def score(self, episode=0, stall=0.0, vector=VECTOR):
        self.wait_ready()
        made = job(episode, spec=self.spec)
        self.slot.submit([(replace(made, stall=stall) if stall else made, vector)])
        return self.result()
