"""Work for several processes, each result as it comes; no process hangs its parent or outlives it.

`concurrent.futures` alone waits for ever where a process crashed and left another behind, which holds its pipes.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from multiprocessing.process import BaseProcess
from time import monotonic, sleep
from typing import Any, TypeVar

from dreamfleet.common.host.descendants import Descendants
from dreamfleet.common.host.parent_death import signals_blocked

LOOK_INTERVAL = 1.0  # seconds between two looks whether all processes run
EXIT_GRACE = 2.0  # seconds that processes may take to exit once there is no more work
Item = TypeVar("Item")
Answer = TypeVar("Answer")


def map_in_processes(
    count: int, start: Callable[..., None], arguments: tuple[Any, ...], work: Callable[[Item], Answer],
    items: Sequence[Item],
) -> Generator[Answer, None, None]:  # fmt: skip
    """Yield `work(item)` of each item as it ends, in `count` spawned processes that begin with `start(*arguments)`.

    `BrokenProcessPool` if a process ends early. When closed early, it waits until what runs is done; after any other
    exception it ends the processes at once.
    """
    others, descendants = set(active_children()), Descendants()
    pool = ProcessPoolExecutor(min(count, len(items)), get_context("spawn"), start, arguments)
    try:
        with signals_blocked(), descendants.starting():
            futures = [pool.submit(work, each) for each in items]
        processes = set(active_children()) - others
        try:
            yield from _results(futures, processes)
        except GeneratorExit:
            for _ in _results([each for each in futures if not each.cancel()], processes):
                pass
        pool.shutdown(wait=False, cancel_futures=True)
        until = monotonic() + EXIT_GRACE
        while any(each.is_alive() for each in processes) and monotonic() < until:
            sleep(0.005)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        descendants.kill()


def _results(futures: Sequence[Future[Answer]], processes: set[BaseProcess]) -> Iterator[Answer]:
    """The results as they come; `BrokenProcessPool` if a process has ended before the last."""
    waiting = set(futures)
    while waiting:
        done, waiting = wait(waiting, LOOK_INTERVAL, FIRST_COMPLETED)
        for each in done:
            yield each.result()
        if not done and not all(each.is_alive() for each in processes):
            raise BrokenProcessPool
