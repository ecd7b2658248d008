"""Optional: a task that scores candidates in batches, as the dream does, and batches that can be watched."""

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.tasks.api import Assignment, Score
from dreamfleet.worker.tasks.watching import StepObserver

Episode = tuple[NDArray[np.float32], int]
"""A candidate's flat parameter vector, and the seed of the episode."""


class Batch(Protocol):
    """Scores many episodes together; each score has the same bits as when it is scored alone."""

    def score(self, episodes: Sequence[Episode], on_step: Callable[[int], None]) -> list[Score]:
        """The score of each episode; calls `on_step` with the number of steps so far, over all episodes."""


@runtime_checkable
class WatchableBatch(Protocol):
    """Optional: a batch whose episodes can be watched."""

    def watched(self, observer: StepObserver) -> Batch:
        """The same batch with the same scores, which passes steps of one episode to `observer`."""


@runtime_checkable
class BatchedTask(Protocol):
    """A task that scores candidates in batches. Its evaluations are still driven in its environment."""

    def make_batch(self, assignment: Assignment) -> Batch:
        """A batch that scores candidates; `BundleError` if the bundle cannot do that.

        Called again whenever the specification's horizon or patience changes.
        """
