"""All hosts in parallel: a thread each, a failure is a row of the table, and Ctrl-C stops them."""

import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from functools import partial

from dreamfleet.common.errors import DreamfleetError, StoppedError
from dreamfleet.common.host.stop_signals import Stop, stop_on_signals
from dreamfleet.coordinator.addons.spawn.config import Host
from dreamfleet.coordinator.addons.spawn.remote_host import FAILED, FleetAddress, HostStatus, RemoteHost

log = logging.getLogger(__name__)
POLL_INTERVAL = 0.2  # seconds between checks for a stop

OnLogLine = Callable[[str, str], None]
"""A host's name and a line of its worker's log."""


def check(hosts: Sequence[Host], fleet_address: FleetAddress) -> list[HostStatus]:
    """Describe each host; changes nothing."""
    return _run_on_all(hosts, fleet_address, RemoteHost.check)


def end(hosts: Sequence[Host], *, all_workers: bool, now: bool, keep: bool) -> list[HostStatus]:
    """End the worker of each host, or all workers there, and remove their files."""
    known = {each.name for each in hosts}
    do = partial(RemoteHost.end, all_workers=all_workers, now=now, keep=keep, known=known)
    return _run_on_all(hosts, FleetAddress(()), do)


def bring_up(
    hosts: Sequence[Host], fleet_address: FleetAddress, on_statuses: Callable[[Sequence[HostStatus]], None],
    on_log_line: OnLogLine | None,
) -> list[HostStatus]:  # fmt: skip
    """Start a worker on each host. With `on_log_line` or a tunnel, return only when they end or at Ctrl-C.

    Calls `on_statuses` when all are up and when they ended, `on_log_line` for each line of a log.
    """
    with _opened(hosts, fleet_address, on_log_line) as (remote_hosts, stop):
        rows = _run_in_threads(remote_hosts, RemoteHost.bring_up, stop, RemoteHost.close)
        if stop():
            raise StoppedError("some workers may run: the same command continues, and `dreamfleet down` ends them")
        on_statuses(rows)
        up = [each for each, row in zip(remote_hosts, rows, strict=True) if row.state != FAILED]
        held = [each for each in up if each.forwards]
        if held:
            names = ", ".join(each.host.name for each in held)
            log.info("%s: the worker reaches its coordinator through this command, and ends with it (Ctrl-C)", names,
                     extra={"facts": {"event": "tunnels"}})  # fmt: skip
        if watched := up if on_log_line else held:
            ended = _run_in_threads(watched, _follow_until_ended, stop, RemoteHost.stop_following)
            then = dict(zip(watched, ended, strict=True))
            rows = [then.get(each, row) for each, row in zip(remote_hosts, rows, strict=True)]
            on_statuses(rows)
    return rows


def _follow_until_ended(remote_host: RemoteHost) -> HostStatus:
    """Follow a worker until it ends or the command stops, which ends a worker that uses our tunnel."""
    try:
        row = remote_host.follow()
    except DreamfleetError as error:  # now, since other workers may go on for days
        log.warning("%s: %s", remote_host.host.name, error, extra={"facts": {"event": "lost"}})
        raise
    if row is not None:
        log.info("%s: its worker ended", remote_host.host.name, extra={"facts": {"event": "ended"}})
    if row is None and not remote_host.forwards:
        return HostStatus(remote_host.host.name, "running", "continues without this command; `dreamfleet down` ends it")
    ended = remote_host.end(all_workers=False, now=False, keep=True) if remote_host.forwards else None
    return row or ended or HostStatus(remote_host.host.name, "ended", "")


def _run_on_all(
    hosts: Sequence[Host], fleet_address: FleetAddress, do: Callable[[RemoteHost], HostStatus]
) -> list[HostStatus]:
    with _opened(hosts, fleet_address) as (remote_hosts, stop):
        rows = _run_in_threads(remote_hosts, do, stop, RemoteHost.close)
        if stop():
            raise StoppedError("interrupted: the same command continues")
        return rows


@contextmanager
def _opened(
    hosts: Sequence[Host], fleet_address: FleetAddress, on_log_line: OnLogLine | None = None
) -> Iterator[tuple[list[RemoteHost], Stop]]:
    """Yield the hosts, whose connections are closed at the end, and whether a signal asks to stop."""
    take_line = on_log_line or (lambda _host, _line: None)
    with stop_on_signals() as stop, ExitStack() as stack:
        remote_hosts = [
            RemoteHost(each, fleet_address, partial(log.info, "%s %s", each.name), partial(take_line, each.name))
            for each in hosts
        ]
        for remote_host in remote_hosts:
            stack.callback(remote_host.release)
        yield remote_hosts, stop


def _run_in_threads(
    remote_hosts: Sequence[RemoteHost], do: Callable[[RemoteHost], HostStatus], stop: Stop,
    leave: Callable[[RemoteHost], None],
) -> list[HostStatus]:  # fmt: skip
    """The status of `do` for each host. The first Ctrl-C calls `leave` for each, the second closes all connections."""
    left = False
    with ThreadPoolExecutor(max(len(remote_hosts), 1)) as pool:
        futures = [pool.submit(_status_of, remote_host, do) for remote_host in remote_hosts]
        try:
            while wait(futures, POLL_INTERVAL, FIRST_EXCEPTION).not_done:
                if stop() and not left:
                    left = True
                    for remote_host in remote_hosts:
                        leave(remote_host)
        except BaseException:
            for remote_host in remote_hosts:
                remote_host.close()
            raise
        return [each.result() for each in futures]


def _status_of(remote_host: RemoteHost, do: Callable[[RemoteHost], HostStatus]) -> HostStatus:
    try:
        return do(remote_host)
    except DreamfleetError as error:
        return HostStatus(remote_host.host.name, FAILED, str(error))
