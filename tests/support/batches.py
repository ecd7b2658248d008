"""Real runs that score submitted batches: a coordinator, workers, and counts of what was scored."""

import numpy as np

from dreamfleet import RemoteScorer
from tests.support import tasks
from tests.support.journals import change_journal

SIZE = 867  # parameters of a linear controller of the random bundle
TIMEOUT = 120.0


def begin(processes, bundle, *more, task=tasks.TOY, name="test"):
    return processes.coordinator("--bundle", bundle.path, "--task", task, "--optimiser", "external", *more, name=name)


def scorer(processes, endpoint=None, name="test"):
    return RemoteScorer(endpoint or processes.endpoint, name, timeout=TIMEOUT)


def vectors(count, first=0.0):
    """Different vectors, the same in every test."""
    return np.linspace(first, first + 1, count * SIZE, dtype=np.float32).reshape(count, SIZE)


def count_results(processes):
    """Accepted results, and their environment steps."""
    return change_journal(processes.runs / "test", "SELECT count(*), sum(steps) FROM result")[0]
