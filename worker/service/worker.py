"""A worker process: it connects, joins a run, serves it, and leaves; with `--any`, it serves one run after another."""

from __future__ import annotations

import logging
import math
import queue
import random
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from time import monotonic
from typing import Any

import zenoh

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import BundleStore, default_cache
from dreamfleet.common.errors import (
    AccessError,
    ConnectionFailedError,
    DownloadError,
    HandshakeRejectedError,
    RefusedError,
)
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import CountingDecoder
from dreamfleet.common.security.credentials import add_seat_to_name
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.worker.service.admission import Admission, find_run_with_fewest_slots, make_request, request_admission
from dreamfleet.worker.service.bundle_fetch import fetch_bundle
from dreamfleet.worker.service.config import WorkerConfig
from dreamfleet.worker.service.farewell import describe_failure
from dreamfleet.worker.service.membership import LeaveConditions, Membership
from dreamfleet.worker.service.refusal_backoff import SINGLE_RUN_DELAYS, RefusalBackoff
from dreamfleet.worker.service.run_session import CoordinatorLink, RunSession
from dreamfleet.worker.service.sender import CoordinatorSender
from dreamfleet.worker.service.slot_pool import SlotPool
from dreamfleet.worker.tasks.registry import check_world_allowed, find_task, known_tasks

log = logging.getLogger(__name__)
RETRY = 1.0  # seconds between attempts to connect or join


class Worker:
    """One worker process."""

    def __init__(self, config: WorkerConfig, network: Network, tasks: tuple[str, ...] = ()) -> None:
        for name in tasks:
            find_task(name)  # fails now, rather than after a run has accepted this worker
        self.identity = keys.new_worker_identity(config.name)
        if network.credentials is not None:
            label, _, life = self.identity.partition("/")
            self.identity = f"{add_seat_to_name(label, network.credentials)}/{life}"
        self.inbox = CountingDecoder()
        self._config = config
        self._network = network
        self._slot_count = config.slots or usable_cores()
        self._hello = make_request(
            self.identity, (*known_tasks(), *tasks), self._slot_count,
            leaves_with_run=config.exit_when_done or config.any,
        )  # fmt: skip
        lifetime = min(config.lifetime or math.inf, self._seconds_until_expiry)
        conditions = LeaveConditions(
            lifetime, config.drain_timeout, config.exit_when_done, config.any, config.coordinator_timeout
        )
        self._membership = Membership(conditions, monotonic())
        self._refusals = RefusalBackoff() if config.any else RefusalBackoff(*SINGLE_RUN_DELAYS)
        self._events: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()

    def stop(self) -> None:
        """The first call: finish running jobs and leave. The second: leave now. Safe in a signal handler."""
        self._membership.stop()
        self._events.put(("wake", None))

    def serve(self) -> None:
        """Work until stopped, or until the run is over if configured so; `AccessError` if the join file expired."""
        session = self._startup()
        if session is not None:
            try:
                self._main_loop(session)
            finally:
                session.close()  # type: ignore[no-untyped-call]
        credentials = self._network.credentials
        if credentials is not None and self._seconds_until_expiry <= 0:
            raise AccessError(
                f"the join file of {credentials.identity} ({credentials.name}) expires at "
                f"{credentials.expires:%Y-%m-%d %H:%M} UTC: have it issued again, and start this "
                "worker with that"
            )

    @property
    def _seconds_until_expiry(self) -> float:
        """Seconds until it must start to drain, because links are closed when the join file expires."""
        credentials = self._network.credentials
        if credentials is None:
            return math.inf
        return credentials.time_left(datetime.now(UTC)).total_seconds() - self._config.drain_timeout

    def _startup(self) -> zenoh.Session | None:
        """A session, as soon as the router answers; `None` if this worker stops first."""
        failures: Counter[str] = Counter()
        while not self._is_leaving():
            try:
                return open_session(self._network)
            except HandshakeRejectedError as error:
                reason, logged_at = f"{error}; trying again", 2  # a coordinator that just started accepts the next try
            except ConnectionFailedError:
                reason, logged_at = f"waiting for a coordinator at {', '.join(self._network.connect)}", 1
            failures[reason] += 1
            if failures[reason] == logged_at:
                log.warning("%s", reason)
            self._pause()
        return None

    def _main_loop(self, session: zenoh.Session) -> None:
        """Serve one run, or one after another."""
        link = CoordinatorLink(
            session, self.identity, self.inbox, lambda *of: self._request_admission(session, *of), _jittered_retry
        )
        while (admission := self._join(session)) is not None:
            try:
                self._serve_run(link, admission)
            except (RefusedError, DownloadError) as error:
                self._handle_refusal(admission.run, error)
            else:
                if not self._config.any:
                    return

    def _serve_run(self, link: CoordinatorLink, admission: Admission) -> None:
        """Work for a run until it is over or this worker leaves."""
        bundle = None
        with self._farewell(link.session, admission):
            if admission.spec.bundle and (bundle := self._fetch_bundle(link.session, admission)) is None:
                return
        # Each run has its own queue, so that late events of the last run are not taken for this one's.
        self._events = queue.SimpleQueue()
        with ExitStack() as stack:
            with self._farewell(link.session, admission):
                slots = self._open_slots(link.session, admission, bundle)
            stack.callback(slots.stop)
            self._refusals.forget(self._refusal_key(admission.run))
            RunSession(link, admission, self._membership, slots, self._events).serve()

    def _open_slots(self, session: zenoh.Session, admission: Admission, bundle: Bundle | None) -> SlotPool:
        if bundle is not None:
            check_world_allowed(bundle, self._hello.tasks)
        return SlotPool(
            self._slot_count, admission.spec, bundle.path if bundle else None, self._events, self._hello.tasks,
            self._config.slot_memory << 20, lambda: self._fetch_bundle(session, admission) if bundle else None,
        )  # fmt: skip

    @contextmanager
    def _farewell(self, session: zenoh.Session, admission: Admission) -> Iterator[None]:
        """Tell the coordinator why this worker fails before it can score."""
        try:
            yield
        except Exception as error:
            sender = CoordinatorSender(session, self.identity, admission)
            sender.send_farewell(self._slot_count, describe_failure(error))
            raise

    def _join(self, session: zenoh.Session) -> Admission | None:
        """A run that welcomed this worker; `None` if this worker stops first."""
        logged = False
        while not self._is_leaving():
            admission = self._request_any_run(session) if self._config.any else self._request_configured_run(session)
            if admission is not None:
                return admission
            if not logged and not self._refusals.refusing_runs(monotonic()):
                awaited = f"run {self._config.run}" if self._config.run else "a run"
                revoked = "; if it is served already, this join file was revoked" if self._network.credentials else ""
                log.warning("waiting for %s%s", awaited, revoked)
            logged = True
            self._pause()
        return None

    def _request_configured_run(self, session: zenoh.Session) -> Admission | None:
        if self._refusals.refusing_runs(monotonic()):
            return None
        try:
            return self._request_admission(session, self._config.run)
        except RefusedError as error:
            self._handle_refusal("", error)
            return None

    def _request_any_run(self, session: zenoh.Session) -> Admission | None:
        run = find_run_with_fewest_slots(session, self._refusals.refusing_runs(monotonic()))
        try:
            return None if run is None else self._request_admission(session, run)
        except RefusedError as error:
            self._handle_refusal(str(run), error)
            return None

    def _handle_refusal(self, run: str, error: RefusedError | DownloadError) -> None:
        """Raise the error with `--exit-when-done`; otherwise log it and ask again later.

        R23: the reason may pass and anybody could have answered, so the worker asks again with growing pauses.
        """
        if self._config.exit_when_done:
            raise error
        refuser = self._refusal_key(run)
        pause = self._refusals.add(refuser, monotonic())
        if self._refusals.is_news(refuser, str(error)):
            log.warning("%s; asking again in %.0f s, then with growing pauses", error, pause)

    def _refusal_key(self, run: str) -> str:
        """The key of a refusal in `RefusalBackoff`: a worker of one run remembers only one."""
        return run if self._config.any else ""

    def _request_admission(
        self, session: zenoh.Session, run: str | None, host_class: str = "", joined_run_uid: str = ""
    ) -> Admission | None:
        request, secured = replace(self._hello, host_class=host_class), self._network.credentials is not None
        return request_admission(session, run, request, self.inbox, joined_run_uid, secured=secured)

    def _fetch_bundle(self, session: zenoh.Session, admission: Admission) -> Bundle | None:
        store = BundleStore(default_cache())
        return fetch_bundle(session, admission.run, admission.spec.bundle, store, self.inbox, stopped=self._is_leaving)

    def _is_leaving(self) -> bool:
        return self._membership.is_leaving(monotonic())

    def _pause(self) -> None:
        """Wait about `RETRY` seconds, or until stopped."""
        deadline = monotonic() + _jittered_retry()
        while not self._is_leaving() and (left := deadline - monotonic()) > 0:
            try:
                self._events.get(timeout=left)
            except queue.Empty:
                return


def _jittered_retry() -> float:
    return RETRY * random.uniform(0.5, 1.5)  # noqa: S311 - no secret
