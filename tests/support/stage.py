"""Workers with hand-driven coordinators, over real routers."""

import logging
import queue
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from dreamfleet.common.transport.session import Network
from dreamfleet.worker.service.config import WorkerConfig
from dreamfleet.worker.service.worker import Worker
from tests.support import tasks
from tests.support.hand import DEADLINE, Hand
from tests.support.processes import free_port


class Stage:
    """Workers and hand-driven coordinators that end with the test."""

    def __init__(self, bundle):
        self.bundle = bundle
        self.port = free_port()
        self.workers, self.hands = [], []
        self._threads = ThreadPoolExecutor()

    def hand(self, task=tasks.TOY, **more):
        self.hands.append(Hand(self.port, self.bundle, task, **more))
        return self.hands[-1]

    def also(self, hand, task=tasks.TOY, **more):
        """Another run's coordinator, on the router of `hand`."""
        self.hands.append(Hand(self.port, self.bundle, task, beside=hand, **more))
        return self.hands[-1]

    def worker(self, endpoint=None, announced=tasks.ALL, network=None, **config):
        """A worker and the future of its `serve`."""
        config = WorkerConfig(**{"run": "test", "slots": 1, **config})
        network = network or Network(connect=(endpoint or f"tcp/127.0.0.1:{self.port}",))
        made = Worker(config, network, announced)
        self.workers.append((made, self._threads.submit(made.serve)))
        return self.workers[-1]

    def served(self, task=tasks.TOY, **config):
        """A coordinator, its worker that can score, and the future of the worker's `serve`."""
        hand = self.hand(task)
        made, served = self.worker(**config)
        hand.ready()
        return hand, made, served

    def error(self, **config):
        """What ends a worker that leaves with its run."""
        return self.worker(exit_when_done=True, **config)[1].exception(DEADLINE)

    def close(self):
        for made, served in self.workers:
            made.stop()
            made.stop()
            served.exception(DEADLINE)
        for each in self.hands:
            each.close()
        self._threads.shutdown()


def event_of(record):
    """What a line reports, if it has a name for that."""
    return f" [{record.facts['event']}]" if hasattr(record, "facts") else ""


@contextmanager
def listening():
    """The log lines of workers as a queue, each with the name of its event."""
    lines = queue.SimpleQueue()
    handler = logging.Handler()
    handler.emit = lambda record: lines.put(f"{record.getMessage()}{event_of(record)}")
    logger = logging.getLogger("dreamfleet.worker")
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    yield lines
    logger.removeHandler(handler)
    logger.setLevel(before)


def wait_for(lines, text):
    while text not in (line := lines.get(timeout=DEADLINE)):
        pass
    return line


def drained(lines):
    return [lines.get_nowait() for _ in range(lines.qsize())]
