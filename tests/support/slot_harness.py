"""A slot with a real child, and the events that it sends."""

import queue
from functools import cache
from time import monotonic

from dreamfleet.common.artifacts.bundle import hash_file
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.service.child import ScorerArguments
from dreamfleet.worker.service.slot import (
    MAX_STARVED_DELAY,
    Slot,
)
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

    def __init__(self, task, bundle, memory_limit, **more):
        self.spec = spec(task, bundle)
        self.events = queue.SimpleQueue()
        self.slot = Slot(0, ScorerArguments(self.spec, bundle, tasks.ALL), self.events, memory_limit, **more)

    def pass_time(self):
        """The longest pause before a start, in no time."""
        self.slot.check(monotonic() + MAX_STARVED_DELAY + 1.0, 0.0)

    def wait_ready(self):
        while not self.slot.ready:
            self.take()

    def take(self):
        """The slot's next event, handled; a child that waits to be started is."""
        self.slot.check(monotonic(), 0.0)
        if self.slot.pid == 0:
            self.pass_time()
        return self.slot.handle(self.events.get(timeout=DEADLINE)[1])

    def result(self):
        while True:
            if results := self.take():
                (result,) = results
                return result

    def outcome(self):
        """The result, and the file that came with it."""
        while True:
            event = self.events.get(timeout=DEADLINE)[1]
            if results := self.slot.handle(event):
                return results[0], event.upload

    def gone(self):
        """The event that the child is gone, not handled yet."""
        while (event := self.events.get(timeout=DEADLINE)[1]).message is not None:
            self.slot.handle(event)
        return event

    def score(self, episode=0):
        self.wait_ready()
        self.slot.submit([(job(episode, spec=self.spec), VECTOR)])
        return self.result()
