"""Poll the live runs: each poll gives an immutable snapshot of all of them."""

import queue
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from dreamfleet.common.addons.analysis.run_archive import RunArchive
from dreamfleet.common.client.client import Client
from dreamfleet.common.client.status import Population, Status, WorkerStatus, read_document, read_status
from dreamfleet.common.errors import AccessError, ConnectionFailedError, DreamfleetError, HandshakeRejectedError
from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol import keys
from dreamfleet.common.runs.records import StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.common.schema.validation import MalformedError
from dreamfleet.common.transport.network import Network
from dreamfleet.common.transport.session import enqueue_into
from dreamfleet.common.worlds.score_words import score_word, score_word_of_run
from dreamfleet.coordinator.addons.dashboard.curves import RunData, curves, downsample
from dreamfleet.coordinator.addons.dashboard.lanes import Lanes
from dreamfleet.coordinator.addons.dashboard.page_state import RunSnapshot, page_state
from dreamfleet.coordinator.addons.dashboard.stored_runs import describe_archive, read_quartiles
from dreamfleet.coordinator.addons.web.documents import event

ANSWER_TIMEOUT = 1.5  # seconds to wait for answers
TIMEOUT = 5.0  # seconds of slow answers after which a silent run is lost; if others answer fast, at once
MOST_RUNS = 32  # followed at a time
MOST_ROWS = 100_000  # generations, evaluations or workers fetched of a run

T = TypeVar("T")
UNREADABLE = (MalformedError, LookupError, TypeError, ValueError, ArithmeticError)  # of other versions' documents


@dataclass(frozen=True)
class RunEvents:
    """What viewers of a run receive: two serialized server-sent events."""

    page_state: bytes
    curves: bytes


@dataclass(frozen=True)
class DashboardSnapshot:
    """All followed runs at one moment."""

    runs: Mapping[str, RunEvents]
    default_run: str | None  # shown if the viewer names no run
    absent_event: bytes  # sent if the viewer's run is unknown
    statuses: Sequence[Status] = ()  # of live runs, with all known workers

    def find(self, run: str | None) -> RunEvents | None:
        """The run of that name, or the default one."""
        return self.runs.get(run or self.default_run or "")


class Watcher:
    """Follows every live run, or one; called by one thread at a time."""

    def __init__(self, network: Network, run: str | None, runs_dir: Path) -> None:
        self._network = network
        self._only = None if run is None else keys.check_run_name(run)
        self._runs_dir = runs_dir
        self._client: Client | None = None
        self._final_statuses: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._followed: dict[str, _FollowedRun] = {}
        self._past_lanes: dict[str, Lanes] = {}  # by run uid; kept while polling is suspended
        self._problem = ""  # why the last poll failed, in part or whole

    def poll(self) -> DashboardSnapshot:
        """Query all live runs. Bad answers never raise; the snapshot names the problem."""
        self._problem = ""
        began, answered = time.monotonic(), self._query_statuses()
        slow = time.monotonic() - began >= ANSWER_TIMEOUT
        now = time.time()
        for name, document in answered.items():
            with suppress(ConnectionFailedError):  # it left between two queries
                self._update_run(name, document, now)
        for each in self._followed.values():
            if each.name not in answered and (not slow or now - each.heard > TIMEOUT):
                each.lost = each.lost or now
        self._receive_final_statuses(now)
        self._forget_oldest()
        return self._snapshot()

    def suspend(self) -> None:
        """Disconnect while there are no viewers, and forget the runs' states, which will be stale."""
        if self._client is not None:
            self._client.__exit__(None, None, None)
            self._client = None
        self._past_lanes |= {each.uid: each.lanes for each in self._followed.values()}
        self._past_lanes = dict(list(self._past_lanes.items())[-MOST_RUNS:])
        self._followed.clear()

    def _query_statuses(self) -> dict[str, dict[str, Any]]:
        try:
            if self._client is None:
                self._client = Client(self._network)
                heard = enqueue_into(self._final_statuses, "status", max_waiting=MOST_RUNS)
                self._client.session.declare_subscriber(keys.event_status("*"), heard)
            found = self._client.statuses(ANSWER_TIMEOUT)
        except (AccessError, HandshakeRejectedError, MalformedError) as error:
            self._problem = str(error)
            return {}
        except ConnectionFailedError:
            return {}
        named = {str(document.get("run")): document for document in found}
        wanted = [name for name in sorted(named) if self._only in (None, name)]
        return {name: named[name] for name in wanted[:MOST_RUNS]}

    def _update_run(self, name: str, document: dict[str, Any], now: float) -> None:
        assert self._client is not None
        try:
            status = read_status(document)
            followed = self._followed.get(name)
            if followed is None or followed.uid != status.run_uid or followed.is_outdated_by(status):
                former = self._followed.pop(name, None)  # reinsert it as the newest
                followed = self._followed[name] = _FollowedRun(status, self._runs_dir)
                followed.lanes = self._past_lanes.pop(followed.uid, followed.lanes)
                if former is not None and former.uid == followed.uid:
                    followed.lanes = former.lanes
            followed.update(status, self._client, now)
        except UNREADABLE as error:
            self._problem = f"run {name}: {error}"

    def _receive_final_statuses(self, now: float) -> None:
        with suppress(queue.Empty):
            while True:
                _, sample = self._final_statuses.get_nowait()
                with suppress(MalformedError):
                    status = read_status(read_document(sample.payload.to_bytes()))
                    followed = self._followed.get(status.run)
                    if followed is not None and followed.matches(status):
                        followed.update_final(status, now)

    def _forget_oldest(self) -> None:
        """Drop the oldest runs that are no longer live, beyond `MOST_RUNS`."""
        gone = [name for name, each in self._followed.items() if not each.is_live]
        for name in gone[: max(len(self._followed) - MOST_RUNS, 0)]:
            del self._followed[name]

    def _snapshot(self) -> DashboardSnapshot:
        live = [name for name, each in self._followed.items() if each.is_live]
        events = {}
        for name, each in self._followed.items():
            try:
                events[name] = each.events(sorted(live))
            except UNREADABLE as error:  # such as non-numeric values
                self._problem = f"run {name}: {error}"
        default_run = next(reversed(live or list(self._followed)), None)
        absent_event = {
            "link": "absent", "run": "", "live": sorted(live), "address": ", ".join(self._network.connect),
            "trouble": truncate(self._problem, 1000), "only": self._only or "",
        }  # fmt: skip
        statuses = tuple(self._followed[name].full_status for name in sorted(live) if name in events)
        return DashboardSnapshot(events, default_run, event("frame", absent_event), statuses)


@dataclass
class _FollowedRun:
    """What is known of one run so far."""

    status: Status
    runs_dir: Path
    heard: float = 0.0  # seconds since 1970
    lost: float | None = None
    history: list[StoredGeneration] = field(default_factory=list)
    evaluations: list[StoredEvaluation] = field(default_factory=list)
    lanes: Lanes = field(default_factory=Lanes)
    _word: str = "seed"
    _workers: Sequence[WorkerStatus] = ()
    _population: Sequence[Population] = ()
    _quartiles: dict[int, tuple[float, float]] | None = None  # `None`: no journal of it here
    _archive: RunArchive | None = None  # of a run with one, whose journal is on this disk
    _archived: int = 0  # generations whose candidates are in it
    _rendered_curves: tuple[Any, bytes] = (None, b"")  # cache key, event

    def __post_init__(self) -> None:
        self._word = score_word(self.status.settings.task.task)
        with suppress(DreamfleetError), open_run(self.runs_dir, self.name) as stored:
            if stored.uid == self.uid:
                self._quartiles, self._archive = {}, RunArchive.empty(stored.settings)
                self._word = score_word_of_run(stored.spec, stored.bundle_path)

    @property
    def name(self) -> str:
        return self.status.run

    @property
    def uid(self) -> str:
        """The run's uid; a later run of the same name has another."""
        return self.status.run_uid

    @property
    def is_live(self) -> bool:
        """Whether its coordinator answers."""
        return self.lost is None and not self.status.is_over

    @property
    def full_status(self) -> Status:
        return replace(self.status, worker_list=tuple(self._workers))

    def matches(self, final_status: Status) -> bool:
        """Whether a final status belongs to this run, and not to an earlier incarnation."""
        return final_status.run_uid == self.uid and final_status.incarnation >= self.status.incarnation

    def is_outdated_by(self, status: Status) -> bool:
        """Whether generations may be others than those known here: results were recalled, or a copy was resumed."""
        return status.incarnation != self.status.incarnation or len(self.history) > status.generations

    def update(self, status: Status, client: Client, now: float) -> None:
        self.status, self.heard, self.lost = status, now, None
        self._workers, self._population = status.worker_list, (status.population,)
        self.lanes.update(self._workers, now)
        self._fetch_missing_rows(status, client)
        if status.workers.known > len(status.worker_list):
            self._workers = list(_fetch_rows(client, "workers", WorkerStatus, self.name))
            self.lanes.update(self._workers, now)
        if status.population.total > len(status.population.done):
            self._population = client.candidates(self.name, status.generation.number)

    def update_final(self, status: Status, now: float) -> None:
        """Take the status that the coordinator published as it left."""
        self.status, self.heard, self.lost = status, now, None
        self._workers, self._population = status.worker_list, (status.population,)
        self._append_recent(status)

    def events(self, live: list[str]) -> RunEvents:
        snapshot = RunSnapshot(
            self.status, self._workers, self.lanes.render(self._workers), self._population, self.heard, self.lost,
            folder=None if self._quartiles is None else self.runs_dir / self.name, word=self._word,
        )  # fmt: skip
        self._render_curves()
        frame = event("frame", {**page_state(snapshot), "live": live})
        return RunEvents(frame, self._rendered_curves[1])

    def _fetch_missing_rows(self, status: Status, client: Client) -> None:
        self._append_recent(status)
        if len(self.history) < min(status.generations, MOST_ROWS):
            self._append(_fetch_rows(client, "history", StoredGeneration, self.name, len(self.history)))
        if len(self.evaluations) != status.evaluations:
            self._fetch_evaluations(status, client)

    def _append_recent(self, status: Status) -> None:
        if status.recent and status.recent[0].number <= len(self.history) < MOST_ROWS:
            self._append(each for each in status.recent if each.number >= len(self.history))

    def _append(self, rows: Iterable[StoredGeneration]) -> None:
        for each in rows:
            if each.number != len(self.history):
                raise MalformedError(f"run {self.name} lists generation {each.number} after {len(self.history) - 1}")
            self.history.append(each)

    def _fetch_evaluations(self, status: Status, client: Client) -> None:
        last = status.evaluation
        latest = self.evaluations[-1].generation if self.evaluations else -1
        if last is not None and last.generation > latest and len(self.evaluations) + 1 == status.evaluations:
            self.evaluations.append(last)
            return
        found = _fetch_rows(client, "evaluations", StoredEvaluation, self.name)
        self.evaluations = sorted({each.generation: each for each in found}.values(), key=lambda each: each.generation)

    def _render_curves(self) -> None:
        of = len(self.history), tuple(self.evaluations[-1:]), len(self.evaluations), self.status.confirmed
        if self._rendered_curves[0] == of:
            return
        status = self.status
        data = RunData(status.settings, self.history, self.evaluations, status.confirmed, status.episode_limit)
        try:
            if self._quartiles is not None or self._archive is not None:
                with open_run(self.runs_dir, self.name) as stored:
                    self._read_journal(stored)
        except DreamfleetError:  # it was moved away
            self._quartiles = self._archive = None
        drawn = {**curves(data, self._quartiles, word=self._word), "archive": describe_archive(self._archive)}
        self._rendered_curves = of, event("curves", drawn)

    def _read_journal(self, stored: RunFolder) -> None:
        """Read the missing quartiles of drawn generations, and the candidates of newly closed ones."""
        is_own, read = stored.uid == self.uid, self._quartiles
        if read is not None:
            wanted = [each for each in downsample(self.history) if each.number not in read]
            found = read_quartiles(stored, self.status.settings, wanted) if is_own else None
            self._quartiles = None if found is None else {**read, **found}
        if self._archive is not None and is_own and self._archived < len(self.history):
            self._archive.read(stored, self._archived)
            self._archived = len(self.history)


def _fetch_rows(client: Client, part: str, kind: type[T], run: str, offset: int = 0) -> Iterator[T]:
    """The rows of a paged part from `offset` on, at most `MOST_ROWS` in all."""
    return islice(client.fetch_rows(part, kind, run, offset), MOST_ROWS - offset)
