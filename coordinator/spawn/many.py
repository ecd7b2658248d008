"""All hosts at once: each in a thread of its own, what fails is its row, and Ctrl-C is heard meanwhile."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import ExitStack
from functools import partial

from dreamfleet.common.errors import DreamfleetError, StoppedError
from dreamfleet.common.stopping import Stop, heeding_signals
from dreamfleet.coordinator.spawn.config import Host
from dreamfleet.coordinator.spawn.visit import FAILED, Reach, Row, Visit

log = logging.getLogger(__name__)
LOOK = 0.2  # seconds between looks at whether to stop

Tell = Callable[[Sequence[Row]], None]
Show = Callable[[str, str], None]
"""A host's name and a line of its worker's log."""


def look(hosts: Sequence[Host], reach: Reach) -> list[Row]:
    """How each host is; nothing is changed there."""
    return _once(hosts, reach, Visit.look)


def end(hosts: Sequence[Host], *, all_workers: bool, now: bool, keep: bool) -> list[Row]:
    """End the worker of each host, or all that are there, and what belongs to them."""
    return _once(hosts, Reach(()), partial(Visit.end, all_workers=all_workers, now=now, keep=keep))


def bring_up(hosts: Sequence[Host], reach: Reach, tell: Tell, show: Show | None) -> list[Row]:
    """Have a worker run on each host; with `show`, or where it lives by a tunnel, until it ends or Ctrl-C.

    `tell` is given the rows when all are up, `show` lines of their logs.
    """
    with heeding_signals() as stop, ExitStack() as stack:
        visits = _visits(hosts, reach, stack, show or _unshown)
        rows = _at_all(visits, Visit.bring_up, stop, Visit.close)
        if stop():
            raise StoppedError(
                "interrupted: some workers may run; the same command goes on, `dreamfleet down` ends them"
            )
        tell(rows)
        up = [visit for visit, row in zip(visits, rows, strict=True) if row.state != FAILED]
        held = [visit for visit in up if visit.forwards]
        if held:
            log.info("%s: the worker reaches its coordinator through this command, and ends with it (Ctrl-C)",
                     ", ".join(visit.host.name for visit in held))  # fmt: skip
        if watched := up if show else held:
            then = dict(zip(watched, _at_all(watched, _stay, stop, Visit.leave), strict=True))
            rows = [then.get(visit, row) for visit, row in zip(visits, rows, strict=True)]
            tell(rows)
    return rows


def _stay(visit: Visit) -> Row:
    """Until the worker ends, or somebody wants to leave: then one that lives by our tunnel leaves first."""
    row = visit.follow()
    if row is None and not visit.forwards:
        return Row(visit.host.name, "running", "goes on without this command; `dreamfleet down` ends it")
    ended = visit.end(all_workers=False, now=False, keep=True) if visit.forwards else None
    return row or ended or Row(visit.host.name, "ended", "")


def _once(hosts: Sequence[Host], reach: Reach, do: Callable[[Visit], Row]) -> list[Row]:
    with heeding_signals() as stop, ExitStack() as stack:
        rows = _at_all(_visits(hosts, reach, stack, _unshown), do, stop, Visit.close)
        if stop():
            raise StoppedError("interrupted: the same command goes on")
        return rows


def _visits(hosts: Sequence[Host], reach: Reach, stack: ExitStack, show: Show) -> list[Visit]:
    visits = [Visit(each, reach, partial(log.info, "%s %s", each.name), partial(show, each.name)) for each in hosts]
    for visit in visits:
        stack.callback(visit.close)
    return visits


def _at_all(
    visits: Sequence[Visit], do: Callable[[Visit], Row], stop: Stop, leave: Callable[[Visit], None]
) -> list[Row]:
    """What `do` says of each; at the first Ctrl-C each is told to `leave`, at the second all connections end."""
    left = False
    with ThreadPoolExecutor(max(len(visits), 1)) as pool:
        futures = [pool.submit(_row, visit, do) for visit in visits]
        try:
            while wait(futures, LOOK, FIRST_EXCEPTION).not_done:
                if stop() and not left:
                    left = True
                    for visit in visits:
                        leave(visit)
        except BaseException:
            for visit in visits:
                visit.close()
            raise
        return [each.result() for each in futures]


def _row(visit: Visit, do: Callable[[Visit], Row]) -> Row:
    try:
        return do(visit)
    except DreamfleetError as error:
        return Row(visit.host.name, FAILED, str(error))


def _unshown(_host: str, _line: str) -> None:
    """Nobody wants to see it."""
