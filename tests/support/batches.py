"""Real runs that score submitted batches: a coordinator, workers, and counts of what was scored."""

import sqlite3

import numpy as np

from dreamfleet import RemoteScorer
from dreamfleet.common.runs.run_paths import JOURNAL
from tests.support import tasks

SIZE = 867  # parameters of a linear controller of the random bundle
TIMEOUT = 120.0


def begin(processes, bundle, *more, task=tasks.TOY, name="test"):
    return processes.coordinator("--bundle", bundle.path, "--task", task, "--optimiser", "external", *more, name=name)


def scorer(processes, endpoint=None, name="test"):
    return RemoteScorer(endpoint or processes.endpoint, name, timeout=TIMEOUT)


def vectors(count, first=0.0):
    """Different vectors, the same in every test."""
    return np.linspace(first, first + 1, count * SIZE, dtype=np.float32).reshape(count, SIZE)


def rows(processes, query, name="test"):
    """What a run's journal says now."""
    where = (processes.runs / name / JOURNAL).absolute().as_uri()
    connection = sqlite3.connect(f"{where}?mode=ro", uri=True, timeout=30)
    try:
        return connection.execute(query).fetchall()
    finally:
        connection.close()


def count_results(processes, name="test"):
    """Accepted results, and their environment steps."""
    return rows(processes, "SELECT count(*), sum(steps) FROM result", name)[0]
