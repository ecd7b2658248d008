"""Work for several processes, each result as it comes; no process hangs its parent or outlives it.

`concurrent.futures` waits for ever where a process hangs, or crashed and left another behind, which holds its pipes.
And it cannot say which piece of work a process was lost with.
"""

from __future__ import annotations

import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from time import monotonic
from typing import Any, Generic, NoReturn, TypeVar

from dreamfleet.common.host.child import FunctionChild
from dreamfleet.common.host.foreign_code import send_stdout_to_stderr
from dreamfleet.common.host.stall_watch import START_LIMIT, StallWatch, describe_stall
from dreamfleet.common.host.user_code import keep_user_arguments

LOOK_INTERVAL = 1.0  # seconds between two looks whether all processes run
SEND_LIMIT = int(START_LIMIT)  # seconds that a process may take to read an item that its pipe does not hold
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

    The processes end with this one, and leave Ctrl-C and SIGTERM to it.

    An item whose answer `has_failed`, or that ends its process, is worked on once more in a fresh process, unless it
    was its process's first: an earlier item may have spoilt that process. So no failure follows from `count`.

    A process that ends early is replaced. `on_loss` makes the answer of its item; it gets the exit status, or why the
    process was killed. Without it, `BrokenProcessPool` ends the work. With `stall`, a process is killed that does not
    call `count_step` for so many seconds, or for `START_LIMIT` before its first step.
    About once in `LOOK_INTERVAL`, `on_look` gets the steps so far of the processes that work.

    When closed early, it waits until what runs is done; after any other exception it ends the processes at once.
    """
    serve = partial(_serve, start, arguments, work)
    idle = [_Process[Item, Answer](serve, stall) for _ in range(min(count, len(items)))]
    pool = _Pool(deque(items), idle, on_loss, on_look, has_failed)
    processes = tuple(idle)
    try:
        try:
            yield from pool.answers()
        except GeneratorExit:
            pool.waiting.clear()
            for _ in pool.answers():
                pass
        children = [each.child for each in processes if each.child]
        for child in children:
            child.send(None)
        until = monotonic() + EXIT_GRACE
        for child in children:
            child.wait(until - monotonic())
    finally:
        for each in processes:
            each.kill()


class _Process(Generic[Item, Answer]):
    """A process that works on one item at a time. If it is lost, the next item starts another."""

    def __init__(self, serve: Callable[..., None], stall: float) -> None:
        self._serve, self._stall = serve, stall
        self._counter: Any = get_context("spawn").Value("Q", 0, lock=False)
        self.child: FunctionChild | None = None  # it reads items, and ends at a `None`
        self._asked: deque[Future[Answer]] = deque()  # of this child
        self.is_fresh = True  # whether its item is, or was, its first
        self._watch = StallWatch()

    @property
    def steps(self) -> int:
        """Steps that it counted since it was started."""
        return int(self._counter.value)

    def submit(self, item: Item) -> Future[Answer]:
        """Begin the work on an item; start the process if there is none."""
        self._watch.restart()
        self.is_fresh = self.child is None
        if self.child is None:
            self._counter.value, self._asked = 0, deque()
            take = partial(_take, self._asked)
            self.child = FunctionChild(self._serve, self._counter, on_message=take, send_limit=SEND_LIMIT)
        self._asked.append(future := Future[Answer]())
        self.child.send((item,))
        return future

    def find_loss(self, gap: float) -> int | str | None:
        """Why it is of no use any longer, as `on_loss` gets it; `gap` is for how long this host was suspended."""
        assert self.child is not None  # it works
        if self.child.exit_code is not None or not self.child.is_heard:
            self.child.wait(EXIT_GRACE)
            status = self.child.exit_code
            self.kill()
            return "it closed its pipe and ran on" if status is None else status
        quiet = self._watch.quiet_seconds(self.steps, monotonic(), gap)
        limit = self._stall if self.steps else max(self._stall, START_LIMIT)
        if not self._stall or quiet <= limit:
            return None
        self.kill()
        return describe_stall(limit, is_ready=self.steps > 0)

    def kill(self) -> None:
        """End it and what it started."""
        if self.child is not None:
            self.child.end(limit=EXIT_GRACE)
        self.child = None


@dataclass(frozen=True)
class _Pool(Generic[Item, Answer]):
    """Hands items to processes and collects the answers."""

    waiting: deque[Item]
    idle: list[_Process[Item, Answer]]
    on_loss: Callable[[Item, int | str], Answer]
    on_look: Callable[[int], None]
    has_failed: Callable[[Answer], bool]
    running: dict[Future[Answer], tuple[_Process[Item, Answer], Item]] = field(default_factory=dict)

    def answers(self) -> Iterator[Answer]:
        """The answers as they come; what `work` or `on_loss` raises ends them."""
        looked_at = monotonic()
        while self.waiting or self.running:
            while self.waiting and self.idle:
                process, item = self.idle.pop(0), self.waiting.popleft()
                self.running[process.submit(item)] = process, item
            wait(self.running, LOOK_INTERVAL, FIRST_COMPLETED)
            self.on_look(sum(process.steps for process, _ in self.running.values()))
            gap, looked_at = max(0.0, monotonic() - looked_at - LOOK_INTERVAL), monotonic()
            for future, (process, item) in list(self.running.items()):
                is_answered = future.done() and not isinstance(future.exception(), BrokenProcessPool)
                reason = None if is_answered else process.find_loss(gap)
                if not is_answered and reason is None:
                    continue
                del self.running[future]
                failed = reason is not None or (future.exception() is None and self.has_failed(future.result()))
                if failed and not process.is_fresh:
                    process.kill()
                    self.running[process.submit(item)] = process, item
                    continue
                self.idle.append(process)
                yield future.result() if reason is None else self.on_loss(item, reason)


def _take(asked: deque[Future[Answer]], message: tuple[Answer | None, BaseException | None] | None) -> None:
    """Hand on what a process answers, or that it closed its pipe."""
    if not asked:
        return
    future = asked.popleft()
    answer, error = message or (None, BrokenProcessPool())
    future.set_exception(error) if error else future.set_result(answer)  # type: ignore[arg-type]  # perhaps `None`


def _serve(
    start: Callable[..., None], arguments: tuple[Any, ...], work: Callable[[Item], Answer],
    pipe: Connection[Any, Any], steps: Any,
) -> None:  # fmt: skip
    """Be a process of the pool. What it prints goes to stderr: its parent answers on stdout."""
    global _steps  # noqa: PLW0603 - one a process
    send_stdout_to_stderr()
    keep_user_arguments()
    _steps = steps
    start(*arguments)
    while (items := pipe.recv()) is not None:
        try:
            pipe.send((work(*items), None))
        except BaseException as error:  # a simulator may raise anything
            error.add_note(traceback.format_exc())
            try:
                pipe.send((None, error))
            except Exception as fault:  # it cannot be pickled
                pipe.send((None, RuntimeError(f"{type(error).__name__} cannot be sent: {fault}")))
