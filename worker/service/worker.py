"""A worker process: it connects, joins a run, serves it, and leaves; with `--any`, it serves several side by side."""

import logging
import queue
import random
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from threading import Thread
from time import monotonic

import zenoh

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import BundleStore, default_cache
from dreamfleet.common.errors import (
    AccessError,
    ConnectionFailedError,
    DownloadError,
    DreamfleetError,
    HandshakeRejectedError,
    RefusedError,
)
from dreamfleet.common.host.logs import log_event
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import CountingDecoder
from dreamfleet.common.security.credentials import add_seat_to_name
from dreamfleet.common.transport.network import wait_for_listener
from dreamfleet.common.transport.session import CONNECT_TIMEOUT, Network, open_session
from dreamfleet.worker.service.admission import (
    Admission,
    CoordinatorLink,
    find_live_names,
    find_run_with_fewest_slots,
    make_request,
)
from dreamfleet.worker.service.bundle_fetch import fetch_bundle
from dreamfleet.worker.service.child import ScorerArguments
from dreamfleet.worker.service.config import WorkerConfig
from dreamfleet.worker.service.membership import (
    SINGLE_RUN_DELAYS,
    LeaveConditions,
    Membership,
    RefusalBackoff,
    StopRequests,
)
from dreamfleet.worker.service.run_session import Events, RunSession
from dreamfleet.worker.service.sender import CoordinatorSender
from dreamfleet.worker.service.slot_budget import SharedSlots
from dreamfleet.worker.service.slot_pool import SlotPool
from dreamfleet.worker.service.wording import WaitingText, describe_failure, describe_refusal
from dreamfleet.worker.tasks.registry import check_world_allowed, find_task, known_tasks

log = logging.getLogger(__name__)
RETRY = 1.0  # seconds between attempts to connect or join
FIRST_RETRY = 0.1  # the same after the first attempt to join, then doubled up to `RETRY`: a run may just begin
NO_WAIT = 0.2  # seconds to connect where nothing listens
MAX_RETRY = 4.0  # the longest pause between looks for another run beside those that it serves
IDLE_RUN = 30.0  # seconds without a job after which a run does not count for `--runs`: it may be paused
MAX_IDLE_RUNS = 16  # of these beside `--runs` others


class ServedRun:
    """A run that a worker has joined, with what belongs to it alone."""

    def __init__(self, admission: Admission, membership: Membership) -> None:
        self.admission, self.membership = admission, membership
        self.events: Events = queue.SimpleQueue()  # its own, so that another run's late events are not taken for its
        self.session: RunSession | None = None
        self.thread = Thread()
        self.error: Exception | None = None

    @property
    def name(self) -> str:
        """The run's name now: its coordinator may have taken another one."""
        return self.admission.run if self.session is None else self.session.run


class Worker:
    """One worker process."""

    def __init__(
        self, config: WorkerConfig, network: Network, tasks: tuple[str, ...] = (), typed: tuple[str, ...] = ()
    ) -> None:
        """`typed` is the command as its user wrote it, verb and flags, for remedies; empty in a program."""
        self._typed = typed
        for name in tasks:
            find_task(name)  # fails now, rather than after a run has accepted this worker
        self.identity = keys.new_worker_identity(config.name)
        if network.credentials is not None:
            label, _, process = self.identity.partition("/")
            self.identity = f"{add_seat_to_name(label, network.credentials)}/{process}"
        self.inbox = CountingDecoder()
        self._config = config
        self._network = network
        self._slot_count = config.slots or (1 if config.torch_device else usable_cores())  # docs/how-to/gpu.md
        self._hello = make_request(
            self.identity, (*known_tasks(), *tasks), self._slot_count, torch_device=config.torch_device
        )
        self._conditions = LeaveConditions(
            config.lifetime, config.drain_timeout, config.exit_when_done, config.any, config.coordinator_timeout,
            self._join_file_ends,
        )  # fmt: skip
        self._started_at, self._stops = monotonic(), StopRequests()
        self._membership = self._new_membership()  # of no run: it says when the whole worker leaves
        self._refusals = RefusalBackoff() if config.any else RefusalBackoff(*SINGLE_RUN_DELAYS)
        self._silences = RefusalBackoff(*SINGLE_RUN_DELAYS)  # of runs with a status that answer no hello
        self._events: Events = queue.SimpleQueue()
        self._slots = SharedSlots(self._slot_count)
        self._served: list[ServedRun] = []

    def stop(self) -> None:
        """The first call: finish running jobs and leave. The second: leave now. Safe in a signal handler."""
        self._membership.stop()
        for events in (self._events, *(each.events for each in self._served)):
            events.put(("wake", None))

    def serve(self) -> None:
        """Work until stopped, or until the run is over if configured so; `AccessError` if the join file expired."""
        session = self._startup()
        if session is not None:
            secured = self._network.credentials is not None
            self._link = CoordinatorLink(session, self._hello, self.inbox, secured, self._config.torch_device)
            try:
                self._main_loop()
            finally:
                session.close()  # type: ignore[no-untyped-call]
        credentials = self._network.credentials
        if credentials is not None and self._join_file_ends():
            raise AccessError(
                f"the join file of {credentials.identity} ({credentials.name}) expires at "
                f"{credentials.expires:%Y-%m-%d %H:%M} UTC: have it issued again, and start this "
                "worker with that"
            )

    def _join_file_ends(self) -> bool:  # docs/how-to/security.md
        """Whether it must drain, because links are closed when the join file expires."""
        credentials = self._network.credentials
        return credentials is not None and credentials.time_left.total_seconds() <= self._config.drain_timeout

    def _new_membership(self) -> Membership:
        return Membership(self._conditions, self._started_at, self._stops)

    def _startup(self) -> zenoh.Session | None:
        """A session, as soon as the router answers; `None` if this worker stops first."""
        rejections, why = Counter[str](), ""
        waiting = self._waiting_text()
        while not self._is_leaving():
            try:
                listens = wait_for_listener(self._network.connect, CONNECT_TIMEOUT, self._is_leaving)
                return open_session(self._network, timeout=CONNECT_TIMEOUT if listens else NO_WAIT)
            except HandshakeRejectedError as error:
                why = str(error)
                rejections[why] += 1
                if rejections[str(error)] == 2:  # a coordinator that just started accepts the next try
                    log_event(log, "rejected", f"{error}; trying again", level=logging.WARNING)
            except ConnectionFailedError:
                if text := waiting.next(monotonic(), answered=False):
                    log_event(log, "no coordinator", text, level=logging.WARNING)
            self._check_waiting_time(why)
            self._pause()
        return None

    def _check_waiting_time(self, why: str = "") -> None:  # docs/reference/exit-codes.md
        """`ConnectionFailedError` if it leaves with its run, and no coordinator let it in for too long; `why` if known.

        R24: such a worker ends by itself, also where its run ended before it came.
        """
        if self._membership.gives_up(monotonic()):
            run = f"run {self._config.run}" if self._config.run else "a run"
            raise ConnectionFailedError(
                f"no coordinator of {run} let this worker in for {self._config.coordinator_timeout:g} s at "
                f"{', '.join(self._network.connect)}{f' ({why})' if why else ''}; start this worker again once the run "
                "is served, or give it more --coordinator-timeout"
            )

    def _main_loop(self) -> None:
        """Serve one run, or several side by side."""
        self._waiting = self._waiting_text()
        if self._config.any:
            self._serve_any()
            return
        while (admission := self._join()) is not None:
            served = self._register(admission)
            try:
                self._serve_run(served)
            except (RefusedError, DownloadError) as error:
                self._waiting = self._waiting_text()
                self._handle_refusal(admission.run, error)
            else:
                if self._config.exit_when_done or not served.membership.ending:
                    return
                self._waiting = self._waiting_text(served)
            finally:
                self._served.clear()

    def _serve_any(self) -> None:
        """Serve up to `--runs` runs, each in a thread of its own, so that none waits for another's coordinator."""
        pause = RETRY
        try:
            while not self._is_leaving():
                joined = self._has_room and self._start_next_run()
                if not self._served and not joined:
                    self._log_waiting()
                pause = RETRY if joined or not self._served else min(2 * pause, MAX_RETRY)
                if not joined and self._pause(pause):
                    pause = RETRY
        finally:
            for each in self._served:  # after an error too: children end before their worker
                each.events.put(("wake", None))
                each.thread.join()

    @property
    def _has_room(self) -> bool:
        """Whether this worker looks for another run: runs that had no job for a while do not count."""
        served, most = len(self._served), self._config.runs
        if most == 1:
            return not served
        return served < most or (served < most + MAX_IDLE_RUNS and self._slots.busy_runs(IDLE_RUN) < most)

    def _start_next_run(self) -> bool:
        """Join another run, if one is live, and serve it in its thread."""
        admission = self._request_any_run()
        if admission is None:
            return False
        served = self._register(admission)
        served.thread = Thread(target=self._serve_in_thread, args=(served,), name=f"run {admission.run}")
        served.thread.start()
        return True

    def _register(self, admission: Admission) -> ServedRun:
        served = ServedRun(admission, self._new_membership())
        self._served.append(served)
        return served

    def _serve_in_thread(self, served: ServedRun) -> None:
        """Serve a run; the main thread learns how it ended."""
        try:
            self._serve_run(served)
        except Exception as error:
            served.error = error
        self._events.put(("over", served))

    def _end_run(self, served: ServedRun) -> None:
        """Forget a run that is over. An error ends a worker of one run; with `any` the run waits."""
        served.thread.join()
        self._served.remove(served)
        self._waiting, error = self._waiting_text(served), served.error
        if error is not None and not isinstance(error, DreamfleetError):
            log.error("run %s ended by an error of this worker", served.name, exc_info=error)
        if isinstance(error, (RefusedError, DownloadError)) or (error is not None and self._config.any):
            self._handle_refusal(served.name, error)
        elif error is not None:
            raise error

    def _serve_run(self, served: ServedRun) -> None:
        """Work for a run until it is over or this worker leaves."""
        admission, bundle = served.admission, None
        with ExitStack() as stack:
            with self._farewell(admission):
                if admission.spec.bundle and (bundle := self._fetch_bundle(admission)) is None:
                    return
                slots = self._open_slots(served, bundle)
            stack.callback(slots.stop)
            self._events.put(("serving", served))
            served.session = RunSession(self._link, admission, served.membership, slots, served.events)
            served.session.serve()

    def _open_slots(self, served: ServedRun, bundle: Bundle | None) -> SlotPool:
        if bundle is not None:
            check_world_allowed(bundle, self._hello.tasks)
        admission, events, config = served.admission, served.events, self._config
        path = bundle.path if bundle else None
        arguments = ScorerArguments(admission.spec, path, self._hello.tasks, config.torch_device)
        share = self._slots.open(admission.share, lambda: events.put(("wake", None)))
        try:
            return SlotPool(
                share, arguments, events, config.slot_memory << 20,
                lambda: self._fetch_bundle(admission) if bundle else None,
                all_at_once=not config.any or config.runs == 1,
            )  # fmt: skip
        except BaseException:
            share.close()
            raise

    @contextmanager
    def _farewell(self, admission: Admission) -> Iterator[None]:
        """Tell the coordinator why this worker fails before it can score."""
        try:
            yield
        except Exception as error:
            sender = CoordinatorSender(self._link.session, self.identity, admission)
            sender.send_farewell(self._slot_count, describe_failure(error))
            raise

    def _waiting_text(self, served: ServedRun | None = None) -> WaitingText:
        """What to say while no run is served, after the last `served` one."""
        ending = "" if served is None else served.membership.ending
        ended = f"run {served.name} {ending}" if served is not None and ending else ""
        return WaitingText(self._config, self._network, monotonic(), ended)

    def _join(self) -> Admission | None:
        """The configured run, once it welcomed this worker; `None` if this worker stops first."""
        pause = FIRST_RETRY
        while not self._is_leaving():
            if not self._refusals.refusing_runs(monotonic()):
                try:
                    if (admission := self._link.request_admission(self._config.run)) is not None:
                        return admission
                except RefusedError as error:
                    self._handle_refusal("", error)
            if pause > FIRST_RETRY:
                self._log_waiting()
            self._check_waiting_time()
            self._pause(pause)
            pause = min(2 * pause, RETRY)
        return None

    def _log_waiting(self) -> None:
        """Log, as is due, that no run is served."""
        now, session = monotonic(), self._link.session
        if self._refusals.refusing_runs(now):
            return
        answered = bool(session.info.routers_zid())
        if text := self._waiting.next(now, answered=answered, others=lambda: find_live_names(session)):
            log.log(logging.INFO if self._waiting.ended else logging.WARNING, "%s", text)

    def _request_any_run(self) -> Admission | None:
        served, now = {each.name for each in self._served}, monotonic()
        passed_over = self._refusals.refusing_runs(now) | self._silences.refusing_runs(now)
        run = find_run_with_fewest_slots(self._link.session, served | passed_over)
        if run is None:
            return None
        try:
            admission = self._link.request_admission(run)
        except RefusedError as error:
            self._handle_refusal(run, error)
            return None
        if admission is None:  # its coordinator waits for its disk, for example: others go first meanwhile
            self._silences.add(run, monotonic())
        else:
            self._silences.forget(run)
        return admission

    def _handle_refusal(self, run: str, error: Exception) -> None:
        """Raise the error with `--exit-when-done`; otherwise log it and ask again later.

        R23: the reason may pass and anybody could have answered, so the worker asks again with growing pauses.
        """
        if isinstance(error, RefusedError):
            error = RefusedError(describe_refusal(error, self._typed))
        if self._config.exit_when_done:
            raise error
        refuser = self._refusal_key(run)
        pause = self._refusals.add(refuser, monotonic())
        if self._refusals.is_news(refuser, str(error)):
            text = f"{error}; asking again in {pause:.0f} s, then with growing pauses"
            log_event(log, "refused", text, level=logging.WARNING, run=run)

    def _refusal_key(self, run: str) -> str:
        """The key of a refusal in `RefusalBackoff`: a worker of one run remembers only one."""
        return run if self._config.any else ""

    def _fetch_bundle(self, admission: Admission) -> Bundle | None:
        session, store = self._link.session, BundleStore(default_cache())
        return fetch_bundle(session, admission.run, admission.spec.bundle, store, self.inbox, stopped=self._is_leaving)

    def _is_leaving(self) -> bool:
        return self._membership.is_leaving(monotonic())

    def _pause(self, seconds: float = RETRY) -> bool:
        """Wait about so many seconds, or until stopped, or until a run is over; return whether one is."""
        deadline = monotonic() + seconds * random.uniform(0.5, 1.5)  # noqa: S311 - no secret
        while not self._is_leaving() and (left := deadline - monotonic()) > 0:
            try:
                kind, served = self._events.get(timeout=left)
            except queue.Empty:
                return False
            if kind == "serving":
                self._refusals.forget(self._refusal_key(served.name))
            elif kind == "over":
                self._end_run(served)
                return True
        return False
