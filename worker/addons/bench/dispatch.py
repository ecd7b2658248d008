"""Benchmark the coordinator: how close to ideal it keeps its slots busy, and how many jobs per second it handles."""

from __future__ import annotations

import queue
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from importlib import import_module
from importlib.util import find_spec
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.host.child import FunctionChild
from dreamfleet.common.host.processes import VerbProcess
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.worker.addons.bench.measurement import free_endpoint
from dreamfleet.worker.addons.bench.simulated_workers import run_simulated_workers
from dreamfleet.worker.addons.bench.sleep_tasks import NULL_TASK, SLEEP_SECONDS, SLEEP_TASK

SLOTS = 8
CANDIDATES = 200
GENERATIONS = 6  # the first is not counted: workers join during it
NULL_JOBS = 4096  # per generation: 64 candidates x 64 episodes
CROWD_SLOTS, CROWD_ROUNDS = 64, 8  # slots of a simulated worker, and jobs of each slot in a generation
MOST_EPISODES = 10_000  # of a candidate
RUN_SECONDS = 300.0
PEER_SECONDS = 120.0
ROUNDS = -(-CANDIDATES // SLOTS)
Figures = dict[str, Any]


def bench_dispatch(crowd: int) -> Figures:
    """Measure 50 ms jobs on 8 real slots, null jobs on simulated workers, and installed peers (pool, Dask, Ray).

    `crowd` is a number of simulated workers for a third run; 0: none.
    """
    figures: Figures = {}
    with (
        start_run(SLEEP_TASK, CANDIDATES, 1) as run,
        VerbProcess("worker", "--connect", run.endpoint, "--task", SLEEP_TASK, "--slots", SLOTS),
    ):
        run.finish()
        figures["efficiency_50ms"] = round(ROUNDS * SLEEP_SECONDS / run.generation_seconds(), 4)
    with start_run(NULL_TASK, 64, NULL_JOBS // 64) as run, run.crowd(2, 32):
        figures |= run.finish_null_jobs()
    peers = (("pool", "multiprocessing", pool_peer), ("dask", "distributed", dask_peer), ("ray", "ray", ray_peer))
    figures["peers"] = {name: run_peer(peer) for name, package, peer in peers if find_spec(package)}
    if crowd:
        figures["crowd"] = measure_crowd(crowd)
    return figures


def measure_crowd(count: int) -> Figures:
    """Figures of two runs in which simulated workers join, work and leave, with `count` slots in all.

    Null jobs on workers of one slot each; and how close jobs of a second come to the ideal on workers of up to
    `CROWD_SLOTS` slots.
    """
    started = time.monotonic()
    with start_run(NULL_TASK, 64, NULL_JOBS // 64) as run, run.crowd(count, 1):
        null = run.finish_null_jobs()
        crowd = {"workers": count, "seconds_in_all": round(time.monotonic() - started, 1), **null}
    return {**crowd, "efficiency_1s": round(measure_long_jobs(count), 4)}


def measure_long_jobs(slots: int) -> float:
    """The ideal makespan of a generation of jobs of a second divided by the measured one, on `slots` or a few more."""
    workers = -(-slots // CROWD_SLOTS)
    slots = workers * CROWD_SLOTS
    parts = -(-slots // MOST_EPISODES)
    with (
        start_run(NULL_TASK, CROWD_ROUNDS * parts, slots // parts) as run,
        run.crowd(workers, CROWD_SLOTS, seconds=1.0),
    ):
        run.finish()
        return CROWD_ROUNDS / run.generation_seconds()


@contextmanager
def start_run(task: str, population: int, episodes: int, *, external: bool = False) -> Iterator[BenchRun]:
    """Start a coordinator in its own process and folder: a run of `GENERATIONS` generations, or an external one."""
    endpoint = free_endpoint()
    search = ("--optimiser", "external") if external else ("--generations", GENERATIONS, "--evaluate-every", 0)
    with (
        TemporaryDirectory() as folder,
        VerbProcess(
            "coordinator", "--run", "bench", "--runs-dir", folder, "--listen", endpoint, "--task", task,
            "--population", population, "--episodes", episodes, *search,
        ) as coordinator,
    ):  # fmt: skip
        yield BenchRun(endpoint, Path(folder), coordinator)


class BenchRun:
    """The run of a real coordinator."""

    def __init__(self, endpoint: str, runs: Path, coordinator: VerbProcess) -> None:
        self.endpoint, self.coordinator = endpoint, coordinator
        self._runs, self._peak_mb = runs, 0.0

    @contextmanager
    def crowd(self, count: int, slots: int, seconds: float = 0.0) -> Iterator[None]:
        """Start `count` simulated workers in one process, whose jobs take so many `seconds`."""
        arguments = self.endpoint, count, slots, seconds
        with FunctionChild(run_simulated_workers, *arguments, on_message=lambda _message: None, is_own=True):
            yield

    def finish(self) -> None:
        """Wait until the run ends; `DreamfleetError` if it fails or takes too long."""
        deadline = time.monotonic() + RUN_SECONDS
        while self.coordinator.exit_code is None:
            self._peak_mb = max(self._peak_mb, self.coordinator.memory / 1e6)
            if time.monotonic() > deadline:
                raise DreamfleetError(f"the run did not end within {RUN_SECONDS:g} s")
            time.sleep(0.1)
        if self.coordinator.exit_code:
            raise DreamfleetError("the run's coordinator failed")

    def finish_null_jobs(self) -> Figures:
        """Wait until the run ends; its jobs per second, and the coordinator's peak memory."""
        self.finish()
        rate = round(NULL_JOBS / self.generation_seconds())
        return {"null_jobs_per_second": rate, "coordinator_rss_mb": round(self._peak_mb, 1)}

    def generation_seconds(self) -> float:
        """The median makespan of a generation, in seconds; the first one, in which workers join, is left out."""
        with open_run(self._runs, "bench") as run:
            return statistics.median(each.seconds for each in run.history()[1:])


# ---- peers: the same work ----


def sleep_job(_index: int) -> int:
    """Sleep for 50 ms."""
    time.sleep(SLEEP_SECONDS)
    return 0


def null_job(_index: int) -> int:
    """Do nothing."""
    return 0


Mapper = Callable[[Callable[[int], int], int], object]
Peer = Callable[[], AbstractContextManager[Mapper]]


def run_peer(peer: Peer) -> Figures | None:
    """Measure a peer in its own process; `None` if it hangs or fails."""
    answers: queue.SimpleQueue[Figures | None] = queue.SimpleQueue()
    with FunctionChild(_send_figures, peer, on_message=answers.put), suppress(queue.Empty):
        return answers.get(timeout=PEER_SECONDS)
    return None


def _send_figures(pipe: Connection[Figures, Any], peer: Peer) -> None:
    """Measure the same two figures of a peer with 8 processes."""
    with peer() as run:
        run(null_job, 100)  # starts its processes
        started = time.perf_counter()
        run(sleep_job, CANDIDATES)
        makespan = time.perf_counter() - started
        started = time.perf_counter()
        run(null_job, NULL_JOBS)
        null = time.perf_counter() - started
    efficiency = round(ROUNDS * SLEEP_SECONDS / makespan, 4)
    pipe.send({"efficiency_50ms": efficiency, "null_jobs_per_second": round(NULL_JOBS / null)})


@contextmanager
def pool_peer() -> Iterator[Mapper]:
    """The standard library's pool, one job per message."""
    with get_context("spawn").Pool(SLOTS) as pool:
        yield lambda work, count: pool.map(work, range(count), chunksize=1)


@contextmanager
def dask_peer() -> Iterator[Mapper]:
    """A local Dask cluster."""
    dask: Any = import_module("distributed")
    with (
        dask.LocalCluster(n_workers=SLOTS, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        dask.Client(cluster) as client,
    ):
        yield lambda work, count: client.gather(client.map(work, range(count), pure=False))


@contextmanager
def ray_peer() -> Iterator[Mapper]:
    """A local Ray cluster."""
    ray: Any = import_module("ray")
    ray.init(num_cpus=SLOTS, include_dashboard=False, log_to_driver=False)
    try:
        yield lambda work, count: ray.get([ray.remote(work).remote(index) for index in range(count)])
    finally:
        ray.shutdown()
