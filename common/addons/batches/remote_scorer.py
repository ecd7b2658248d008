"""Score vectors on a fleet: ask-and-tell for a search that runs here."""

from __future__ import annotations

import secrets
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import nan
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.addons.batches.batch_client import BatchClient, is_final
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError, DreamfleetError
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.batches import BatchError, BatchEvent, BatchReply, pack_batch
from dreamfleet.common.runs.seeds import remark_on_seeds
from dreamfleet.common.schema.display import Displayed
from dreamfleet.common.transport.session import Network

POLL = 1.0  # seconds between two looks at a batch of which no event arrives
RETRY = 0.25  # seconds until a coordinator that did not answer is asked again
TIMEOUT = 600.0  # seconds without an answer after which a coordinator counts as gone


@dataclass(frozen=True)
class ScoredCandidate:
    """A candidate of a batch: its fitness, or why it has none."""

    index: int
    fitness: float | None  # `None`: it failed
    error: str | None


class RemoteScorer(Displayed):
    """Scores vectors on the fleet of a `run` that was started with `--optimiser external`; use it in a `with`.

    >>> import numpy as np
    >>> from dreamfleet import RemoteScorer, start_run
    >>> with start_run(task="gym:CartPole-v1", optimiser="external", workers=1) as run:
    ...     with RemoteScorer(run.address, run.name) as scorer:  # any coordinator's address
    ...         scorer.score(np.zeros((2, scorer.size)), seeds=[1, 2]).shape
    (2,)

    `timeout` is how many seconds its batches wait for a coordinator that answered before, and was killed and is being
    resumed. Then, and where no coordinator answers at first, `ConnectionFailedError`.
    """

    def __init__(self, connect: Network | tuple[str, ...] | str, run: str, *, timeout: float = TIMEOUT) -> None:
        self.run = run
        self.timeout = timeout
        self._client = Client(connect)
        self._batches = BatchClient(self._client)
        self._changed = threading.Condition()
        self._events: dict[str, BatchEvent] = {}
        self._subscriber = self._batches.on_change(run, self._take_event)

    def _display(self) -> tuple[str, dict[str, object]]:
        return f"RemoteScorer of run {self.run}", {"run": self.run}

    def __enter__(self) -> RemoteScorer:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection; batches go on, and are found again by their ids."""
        self._subscriber.undeclare()
        self._client.session.close()  # type: ignore[no-untyped-call]

    @property
    def size(self) -> int:
        """Numbers of a vector."""
        return self._client.status(self.run).settings.controller.size

    def score(
        self, vectors: object, *, seeds: Sequence[int] | None = None, episodes: int = 0, batch_id: str | None = None
    ) -> NDArray[np.float64]:
        """The fitness `(n,)` of vectors `(n, size)`: larger is better, NaN for candidates that failed.

        All are scored on the same `seeds`; without seeds, on `episodes` fresh ones, or on as many as the run's
        `--episodes` says. The same `batch_id` continues an earlier call.
        """
        return self.submit(vectors, seeds=seeds, episodes=episodes, batch_id=batch_id).wait()

    def submit(
        self, vectors: object, *, seeds: Sequence[int] | None = None, episodes: int = 0, batch_id: str | None = None
    ) -> RemoteBatch:
        """Submit a batch; once this returns, the batch is on the coordinator's disk.

        The same id with the same content is the same batch, and nothing is scored again. `BatchError` if the id is
        taken by another content, or the vectors are not what they must be.
        """
        header, body = pack_batch(batch_id or secrets.token_hex(8), vectors, seeds, episodes)
        if remark := remark_on_seeds(seeds or ()):
            warnings.warn(remark, stacklevel=2)
        return RemoteBatch(self, self.persist(lambda: self._batches.submit(self.run, header, body)))

    def find(self, batch_id: str) -> RemoteBatch:
        """The batch of this id, that this or another process submitted; `BatchError` if there is none."""
        return RemoteBatch(self, self.read(batch_id))

    def read(self, batch_id: str, offset: int = 0) -> BatchReply:
        """The coordinator's reply about a batch, with the page of scores from `offset` on."""
        return self.persist(lambda: self._batches.read(self.run, batch_id, offset))

    def cancel(self, batch_id: str) -> BatchReply:
        """Cancel a batch; a finished one stays as it is."""
        return self.persist(lambda: self._batches.cancel(self.run, batch_id))

    def persist(self, ask: Callable[[], BatchReply]) -> BatchReply:
        """Repeat a query until a coordinator answers that is not too busy; the last error after `timeout` seconds."""
        deadline = monotonic() + self.timeout
        while True:
            try:
                return ask()
            except (ConnectionFailedError, BatchError) as error:
                is_lasting = isinstance(error, BatchError) and error.refusal != "busy"
                if is_lasting or monotonic() >= deadline:
                    raise
            with self._changed:
                self._changed.wait(RETRY)

    def wait_for_change(self, seen: BatchReply) -> None:
        """Wait until an event says that a batch has changed since `seen`, a second at most."""

        def has_changed() -> bool:
            event = self._events.get(seen.id)
            return event is not None and (event.state, event.done) != (seen.state, seen.done)

        with self._changed:
            self._changed.wait_for(has_changed, POLL)
            self._events.pop(seen.id, None)

    def _take_event(self, event: BatchEvent) -> None:
        with self._changed:
            self._events[event.id] = event
            while len(self._events) > 1024:  # of batches that others submitted
                del self._events[next(iter(self._events))]
            self._changed.notify_all()


class RemoteBatch(Displayed):
    """A batch that was submitted to a run; made by `RemoteScorer.submit` and `find`.

    >>> import numpy as np
    >>> from dreamfleet import RemoteScorer, start_run
    >>> with start_run(task="gym:CartPole-v1", optimiser="external", workers=1) as run:
    ...     with RemoteScorer(run.address, run.name) as scorer:
    ...         batch = scorer.submit(np.zeros((2, scorer.size)), seeds=[1, 2], batch_id="first")
    ...         print(len(batch), batch.wait().shape, scorer.find("first").state)
    2 (2,) complete
    """

    def __init__(self, scorer: RemoteScorer, reply: BatchReply) -> None:
        self._scorer = scorer
        self._last = reply

    def _display(self) -> tuple[str, dict[str, object]]:
        facts: dict[str, object] = {"id": self.id, "state": self.state, "done": f"{self.done} of {len(self)}"}
        return f"RemoteBatch {self.id}: {self.state}, {self.done} of {len(self)} done", facts

    def __len__(self) -> int:
        return self._last.population

    @property
    def id(self) -> str:
        """By which it is found again, also by another process."""
        return self._last.id

    @property
    def state(self) -> str:
        """`waiting`, `running`, `complete` or `cancelled`, as last heard; `refresh` asks anew."""
        return self._last.state

    @property
    def done(self) -> int:
        """Candidates that have a fitness or an error, as last heard."""
        return self._last.done

    def refresh(self) -> RemoteBatch:
        """Ask the coordinator how the batch stands now."""
        self._last = self._scorer.read(self.id)
        return self

    def cancel(self) -> str:
        """Cancel it, and return its state: candidates without a fitness then get the error `cancelled`."""
        self._last = self._scorer.cancel(self.id)
        return self.state

    def results(self) -> Iterator[ScoredCandidate]:
        """Yield each candidate once, as soon as it is done."""
        yielded: set[int] = set()
        while True:
            self._last = reply = self._scorer.read(self.id)
            if reply.done > len(yielded) or is_final(reply):
                for found in self._pages(reply):
                    if found.index not in yielded:
                        yielded.add(found.index)
                        yield found
            if is_final(reply):
                return
            self._scorer.wait_for_change(reply)

    def wait(self, timeout: float | None = None) -> NDArray[np.float64]:
        """The fitness `(n,)` once the batch is complete, NaN for candidates that failed; `TimeoutError` before."""
        deadline = None if timeout is None else monotonic() + timeout
        while not is_final(self._last):
            if deadline is not None and monotonic() >= deadline:
                raise TimeoutError(
                    f"batch {self.id} is {self.state}: {self.done} of {plural(len(self), 'candidate')} done"
                )
            self._scorer.wait_for_change(self._last)
            self.refresh()
        fitness = np.full(len(self), nan)
        for found in self._pages(self._last):
            fitness[found.index] = nan if found.fitness is None else found.fitness
        return fitness

    def _pages(self, first: BatchReply) -> Iterator[ScoredCandidate]:
        """The candidates that are done, from all pages, of which `first` is the first."""
        page = first
        while True:
            yield from scored_candidates(page)
            offset = page.offset + len(page.fitness)
            if offset >= page.population:
                return
            page = self._scorer.read(self.id, offset)
            if not page.fitness:
                raise DreamfleetError(f"the coordinator sends no scores of batch {self.id} from {offset} on")


def scored_candidates(page: BatchReply) -> Iterator[ScoredCandidate]:
    """The candidates of a page that have a fitness or an error."""
    errors = {each.candidate: each.error for each in page.errors}
    for index, fitness in enumerate(page.fitness, page.offset):
        if fitness is not None or index in errors:
            yield ScoredCandidate(index, fitness, errors.get(index))
