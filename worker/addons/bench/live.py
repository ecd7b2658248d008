"""Benchmark the live view: the cost of its code while nobody watches, and of a watched slot."""

from __future__ import annotations

import hashlib
import queue
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from time import perf_counter
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.driving import FIRST_WORLD
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.messages import Intervals, Job, TaskSpec
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.worker.addons.bench.measurement import TimedCall, free_endpoint, time_alternately
from dreamfleet.worker.scoring.episode import score
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.service.admission import Admission
from dreamfleet.worker.service.child import ScorerArguments
from dreamfleet.worker.service.frame_publisher import FramePublisher
from dreamfleet.worker.service.frame_sampler import SampledFrame
from dreamfleet.worker.service.job_group import JobWithVector
from dreamfleet.worker.service.slot import Slot
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.registry import find_task

RUN, WORKER = "bench", "bench/00000000"
TASKS = {FIRST_WORLD: 1, "dream": 256}  # jobs per turn
HORIZON = 200  # steps of an episode: a turn takes some tenths of a second, long enough for a few frames
SEED = 2**20
ADMISSION = Admission(RUN, "0" * 32, 1, "bench", TaskSpec(FIRST_WORLD, "", HORIZON, 0), Intervals())
Figures = dict[str, Any]
Floats = NDArray[np.float32]


def bench_live(bundle: Bundle) -> Figures:
    """Measure, for each task, how much longer a turn (one group of jobs) takes with the live view.

    `unwatched`: time of a slot's scorer divided by that of the task's bare loop. `watched`: time of a real slot whose
    frames go through a router to a subscriber, divided by the same slot's without one. `frames_per_second`: the frames
    that arrived during watched turns.
    """
    figures: Figures = {}
    for task, rows in TASKS.items():
        spec = TaskSpec(task, bundle.sha256, HORIZON, 0, temperature=1.0 if task == "dream" else None)
        vectors = np.random.default_rng(0).normal(0, 0.1, (rows, bundle.controller_shape.size)).astype(np.float32)
        bare = time_alternately(_bare_cases(spec, bundle, vectors))
        with watch_slot(spec, bundle, vectors) as slot:
            seconds = time_alternately({"unwatched": slot.score, "watched": slot.score_watched})
        figures[task] = {
            "unwatched": round(bare["scorer"] / bare["loop"], 4),
            "watched": round(seconds["watched"] / seconds["unwatched"], 4),
            "frames_per_second": round(slot.frames / slot.watched, 1),
        }
    return figures


def _bare_cases(spec: TaskSpec, bundle: Bundle, vectors: Floats) -> dict[str, TimedCall]:
    """A turn by a slot's scorer, and by the task's bare loop, which has no live view."""
    scorer, task, assignment = Scorer(spec, bundle), find_task(spec.task), Assignment(spec, bundle)
    jobs = [("score", vector, SEED) for vector in vectors]

    def whole() -> object:
        return scorer.score_all(jobs, lambda _made: None)  # type: ignore[arg-type]

    if len(vectors) > 1:
        batch = task.make_batch(assignment)  # type: ignore[attr-defined]
        episodes = [(vector, SEED) for vector in vectors]
        return {"loop": lambda: batch.score(episodes, lambda _made: None), "scorer": whole}
    environment, policy = task.make_environment(assignment), task.make_policy(assignment)
    episode_config = scorer.episode_config("score", SEED)
    return {"loop": lambda: score(environment, policy, vectors[0], episode_config), "scorer": whole}


@contextmanager
def watch_slot(spec: TaskSpec, bundle: Bundle, vectors: Floats) -> Iterator[WatchedSlot]:
    """Start a worker's slot whose frames go through a router to one subscriber."""
    endpoint = free_endpoint()
    networks = Network(listen=(endpoint,)), Network(connect=(endpoint,)), Network(connect=(endpoint,))
    events: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
    with ExitStack() as stack:
        _, worker, viewer = [stack.enter_context(closing(open_session(network))) for network in networks]
        slot = Slot(0, ScorerArguments(spec, bundle.path, (spec.task,)), events)
        stack.callback(slot.stop)
        jobs = [_make_job(spec, vector, number) for number, vector in enumerate(vectors)]
        watched = WatchedSlot(slot, events, jobs, FramePublisher(worker, RUN, WORKER, lambda _status: None))
        viewer.declare_subscriber(keys.view(RUN, WORKER), zenoh.handlers.Callback(watched.count_frame, indirect=False))
        while not slot.ready:
            slot.handle(events.get()[1])
        yield watched


class WatchedSlot:
    """A slot that runs one group of jobs a turn, with or without a subscriber to its frames."""

    def __init__(
        self, slot: Slot, events: queue.SimpleQueue[tuple[str, Any]], jobs: list[JobWithVector],
        frame_publisher: FramePublisher,
    ) -> None:  # fmt: skip
        self.frames, self.watched = 0, 0.0  # frames that arrived; seconds of watched turns
        self._slot, self._events, self._jobs, self._frame_publisher = slot, events, jobs, frame_publisher

    def score(self) -> None:
        """Run one turn without a subscriber."""
        self._slot.show(False)
        self._score_group()

    def score_watched(self) -> None:
        """Run one turn with a subscriber."""
        self._slot.show(True)
        began = perf_counter()
        self._score_group()
        self.watched += perf_counter() - began

    def _score_group(self) -> None:
        self._slot.submit(self._jobs)
        while True:
            event = self._events.get()[1]
            if isinstance(event.message, SampledFrame):
                work = self._slot.find_job(event.child_number, event.message)
                assert work is not None  # the only turn's
                self._frame_publisher.show(ADMISSION, 0, work, event.message)
            elif self._slot.handle(event):
                return

    def count_frame(self, _sample: object) -> None:
        """Count a frame that arrived."""
        self.frames += 1


def _make_job(spec: TaskSpec, vector: Floats, number: int) -> JobWithVector:
    data = vector.astype("<f4").tobytes()
    digest = spec.digest("score", hashlib.sha256(data).digest(), (SEED,))
    job = Job("score", spec.task, 0, number, 0, (SEED,), hashlib.sha256(data).digest(), digest, 0.0)
    return job, data
