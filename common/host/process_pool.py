"""Work for several processes, each result as it comes; no process hangs its parent or outlives it.

`concurrent.futures` alone waits for ever where a process hangs, or crashed and left another behind, which holds its
pipes. And it cannot say which piece of work a process was lost with. So each process has an executor of its own.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from time import monotonic, sleep
from typing import Any, Generic, NoReturn, TypeVar

from dreamfleet.common.host.descendants import Descendants
from dreamfleet.common.host.foreign_code import send_stdout_to_stderr
from dreamfleet.common.host.parent_death import signals_blocked
from dreamfleet.common.host.stall_watch import START_LIMIT, StallWatch, describe_slow_start, describe_stall
from dreamfleet.common.host.user_code import keep_user_arguments

LOOK_INTERVAL = 1.0  # seconds between two looks whether all processes run
EXIT_GRACE = 2.0  # seconds that processes may take to exit once there is no more work
Item = TypeVar("Item")
Answer = TypeVar("Answer")
_steps: Any = None  # in a child: the count of steps, in memory shared with the parent


def count_step(_made: int = 0) -> None:
    """In a process of `map_in_processes`: tell the parent that the work makes progress."""
    if _steps is not None:
        _steps.value += 1


def _raise_broken(_item: object, reason: int | str) -> NoReturn:
    raise BrokenProcessPool(reason)


def map_in_processes(
    count: int, start: Callable[..., None], arguments: tuple[Any, ...], work: Callable[[Item], Answer],
    items: Sequence[Item], on_loss: Callable[[Item, int | str], Answer] = _raise_broken, stall: float = 0.0,
    on_look: Callable[[int], None] = lambda _steps: None, has_failed: Callable[[Answer], bool] = lambda _answer: False,
) -> Generator[Answer, None, None]:  # fmt: skip
    """Yield `work(item)` of each item as it ends, in `count` spawned processes that begin with `start(*arguments)`.

    An item whose answer `has_failed`, or that ends its process, is worked on once more in a fresh process, unless it
    was its process's first: an earlier item may have spoilt that process. So no failure follows from `count`.

    A process that ends early is replaced. `on_loss` makes the answer of its item; it gets the exit status, or why the
    process was killed. Without it, `BrokenProcessPool` ends the work. With `stall`, a process is killed that does not
    call `count_step` for so many seconds, or for `START_LIMIT` before its first step.
    About once in `LOOK_INTERVAL`, `on_look` gets the steps so far of the processes that work.

    When closed early, it waits until what runs is done; after any other exception it ends the processes at once.
    """
    idle = [_Process[Item, Answer](start, arguments, work, stall) for _ in range(min(count, len(items)))]
    pool = _Pool(deque(items), idle, on_loss, on_look, has_failed)
    processes = tuple(idle)
    try:
        try:
            yield from pool.answers()
        except GeneratorExit:
            pool.waiting.clear()
            for _ in pool.answers():
                pass
        for each in processes:
            each.shut_down()
        until = monotonic() + EXIT_GRACE
        while any(each.is_alive for each in processes) and monotonic() < until:
            sleep(0.005)
    finally:
        for each in processes:
            each.kill()


class _Process(Generic[Item, Answer]):
    """A process that works on one item at a time. If it is lost, the next item starts another."""

    def __init__(
        self, start: Callable[..., None], arguments: tuple[Any, ...], work: Callable[[Item], Answer], stall: float
    ) -> None:
        self._start, self._arguments, self._work, self._stall = start, arguments, work, stall
        self._counter: Any = get_context("spawn").Value("Q", 0, lock=False)
        self._executor: ProcessPoolExecutor | None = None
        self._process: Any = None
        self.is_fresh = True  # whether its item is, or was, its first
        self._descendants, self._watch = Descendants(), StallWatch()

    @property
    def is_alive(self) -> bool:
        """Whether it runs."""
        return self._process is not None and self._process.is_alive()

    @property
    def steps(self) -> int:
        """Steps that it counted since it was started."""
        return int(self._counter.value)

    def submit(self, item: Item) -> Future[Answer]:
        """Begin the work on an item; start the process if there is none."""
        self._watch.restart()
        self.is_fresh = self._executor is None
        if self._executor is not None:
            return self._executor.submit(self._work, item)
        self._counter.value, others = 0, set(active_children())
        arguments = (self._counter, self._start, self._arguments)
        self._executor = ProcessPoolExecutor(1, get_context("spawn"), _begin, arguments)
        with signals_blocked(), self._descendants.starting():
            future = self._executor.submit(self._work, item)
        self._process = next(iter(set(active_children()) - others), None)
        return future

    def find_loss(self, gap: float) -> int | str | None:
        """Why it is of no use any longer, as `on_loss` gets it; `gap` is for how long this host was suspended."""
        if not self.is_alive:
            return self.lose()
        quiet = self._watch.quiet_seconds(self.steps, monotonic(), gap)
        limit = self._stall if self.steps else max(self._stall, START_LIMIT)
        if not self._stall or quiet <= limit:
            return None
        self.kill()
        return describe_stall(limit) if self.steps else describe_slow_start(limit)

    def lose(self) -> int | str:
        """Give it up, after it ended or closed its pipe; return its exit status, or what it did instead."""
        until = monotonic() + EXIT_GRACE
        while (status := getattr(self._process, "exitcode", None)) is None and monotonic() < until:
            sleep(0.005)
        self.kill()
        return "it closed its pipe and ran on" if status is None else int(status)

    def shut_down(self) -> None:
        """Let it end."""
        if self._executor is not None:
            self._executor.shutdown(wait=False, cancel_futures=True)

    def kill(self) -> None:
        """End it and what it started."""
        if self._executor is None:
            return
        self.shut_down()
        if self._process is not None:
            self._process.kill()
        self._descendants.kill()
        self._executor = self._process = None


class _Pool(Generic[Item, Answer]):
    """Hands items to processes and collects the answers."""

    def __init__(
        self, waiting: deque[Item], idle: list[_Process[Item, Answer]], on_loss: Callable[[Item, int | str], Answer],
        on_look: Callable[[int], None], has_failed: Callable[[Answer], bool],
    ) -> None:  # fmt: skip
        self.waiting, self._idle, self._on_loss, self._on_look = waiting, idle, on_loss, on_look
        self._has_failed = has_failed
        self._running: dict[Future[Answer], tuple[_Process[Item, Answer], Item]] = {}

    def answers(self) -> Iterator[Answer]:
        """The answers as they come; what `work` or `on_loss` raises ends them."""
        looked_at = monotonic()
        while self.waiting or self._running:
            while self.waiting and self._idle:
                process, item = self._idle.pop(0), self.waiting.popleft()
                self._running[process.submit(item)] = process, item
            wait(self._running, LOOK_INTERVAL, FIRST_COMPLETED)
            self._on_look(sum(process.steps for process, _ in self._running.values()))
            gap, looked_at = max(0.0, monotonic() - looked_at - LOOK_INTERVAL), monotonic()
            for future, (process, item) in list(self._running.items()):
                if future.done():
                    reason = process.lose() if isinstance(future.exception(), BrokenProcessPool) else None
                elif (reason := process.find_loss(gap)) is None:
                    continue
                del self._running[future]
                failed = reason is not None or (future.exception() is None and self._has_failed(future.result()))
                if failed and not process.is_fresh:
                    process.kill()
                    self._running[process.submit(item)] = process, item
                    continue
                self._idle.append(process)
                yield future.result() if reason is None else self._on_loss(item, reason)


def _begin(steps: Any, start: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    """Initialise a process of the pool. What it prints goes to stderr: its parent answers on stdout."""
    global _steps  # noqa: PLW0603 - one a process
    send_stdout_to_stderr()
    keep_user_arguments()
    _steps = steps
    start(*arguments)
