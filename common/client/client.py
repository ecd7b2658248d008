"""A client of live runs over Zenoh: status, watching, controllers, control. Only `control` changes anything."""

from __future__ import annotations

import base64
import queue
from collections.abc import Collection, Iterator
from contextlib import suppress
from time import monotonic
from typing import Any, TypeVar

import numpy as np

from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.client.status import (
    FINAL_STATES,
    Event,
    Population,
    Status,
    WorkerStatus,
    read_document,
    read_status,
)
from dreamfleet.common.errors import ConnectionFailedError, ControllerError, DreamfleetError, RefusedError, UsageError
from dreamfleet.common.host.add_ons import add_on
from dreamfleet.common.printable import join_some
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import decode_json
from dreamfleet.common.protocol.messages import ControlReply
from dreamfleet.common.runs.records import StoredEvaluation, StoredGeneration
from dreamfleet.common.schema.display import Displayed
from dreamfleet.common.schema.validation import MalformedError, from_plain_lenient
from dreamfleet.common.transport.query import query_all
from dreamfleet.common.transport.session import Network, enqueue_into, open_session

T = TypeVar("T")
QUERY_TIMEOUT = 3.0
NAMES_TIMEOUT, SHOWN_RUNS = 1.0, 4  # of the names of other runs in an error text
TIMEOUT = 1.0  # seconds without an answer after which a watched run counts as gone
MAX_PARAMETERS = 16 << 20  # of a controller; the same as in a controller file
MAX_WAITING_STATUSES = 64  # of those that coordinators publish as they leave
MAX_RESTARTS = 5  # of fetching a controller in parts while new controllers replace it


class Client(Displayed):
    """A connection to the router of one or more runs; use it in a `with`.

    >>> from dreamfleet import Client
    >>> with Client(address) as client:  # where the coordinator listens, such as "tcp/127.0.0.1:7447"
    ...     print(client.runs(), client.status("cartpole").state)
    ['cartpole'] running
    """

    def __init__(self, connect: Network | tuple[str, ...] | str) -> None:
        """`connect` is one or more addresses, or a `Network` with credentials."""
        connect = (connect,) if isinstance(connect, str) else connect
        network = connect if isinstance(connect, Network) else Network(connect=connect)
        if not network.connect:
            raise UsageError("a client needs an address: tcp/HOST:PORT")
        self._where = ", ".join(network.connect)
        self._credentials = network.credentials
        #: the flags with which a worker joins a run here; in a secured fleet each worker has its own join file
        self.worker_flags = "--join FILE" if network.credentials else f"--connect {' '.join(network.connect)}"
        self.session = open_session(network)  # public: for other queries, such as for a bundle

    def _display(self) -> tuple[str, dict[str, object]]:
        with_join_file = "with a join file" if self._credentials else "without a join file"
        return f"Client of {self._where}, {with_join_file}", {"router": self._where, "access": with_join_file}

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_error: object) -> None:
        self.session.close()  # type: ignore[no-untyped-call]

    def runs(self, timeout: float = QUERY_TIMEOUT) -> list[str]:
        """Names of the live runs that answer within `timeout` seconds."""
        return sorted(str(document["run"]) for document in self.statuses(timeout) if "run" in document)

    def status(self, run: str | None = None) -> Status:
        """The status of `run`, or of the only live run; `MalformedError` if its version is not understood."""
        return read_status(self.document(run))

    def statuses(self, timeout: float = QUERY_TIMEOUT) -> list[dict[str, Any]]:
        """The raw statuses of all live runs that answer within `timeout` seconds, unordered.

        Answers that are no status are left out: one run must not hide the others.
        """
        self.check_join_file()
        found = []
        for payload in query_all(self.session, [keys.status("*")], timeout):
            with suppress(MalformedError):
                found.append(read_document(payload))
        return found

    def document(self, run: str | None = None, part: str = "", parameters: str = "") -> dict[str, Any]:
        """The raw status of `run`, or of the only live run; `part` is one of `status.PARTS`."""
        key = keys.status(keys.check_run_name(run) if run else "*", part)
        documents = self._query(f"{key}?{parameters}" if parameters else key)
        if len(documents) > 1:
            names = ", ".join(sorted(str(document.get("run")) for document in documents))
            raise UsageError(f"several runs are live: name one of {names}")
        if not documents:
            raise self._no_answer_error(run)
        return documents[0]

    def watch(self, run: str, pause: float, timeout: float = TIMEOUT) -> Iterator[Status]:
        """Yield the status of `run` every `pause` seconds, and finally the one in which its coordinator leaves.

        `ConnectionFailedError` if nobody answers for `timeout` seconds: the coordinator was killed, or never started.
        Use a longer timeout to wait for a coordinator that is being started.
        """
        return map(read_status, self.watch_documents(run, pause, timeout))

    def show(self, run: str, pause: float = 1.0, timeout: float = TIMEOUT) -> None:
        """Show the status of `run` in a notebook's cell, in place, until its coordinator leaves; errors as in `watch`.

        Interrupting the cell ends the showing and not the run. Outside of a notebook, a line of each status is printed.
        """
        add_on("show-live")(self.watch(run, pause, timeout))

    def watch_documents(self, run: str, pause: float, timeout: float = TIMEOUT) -> Iterator[dict[str, Any]]:
        """Like `watch`, but yields raw statuses."""
        last_statuses: queue.SimpleQueue[Any] = queue.SimpleQueue()
        enqueue = enqueue_into(last_statuses, "status", max_waiting=MAX_WAITING_STATUSES)
        subscriber: Any = self.session.declare_subscriber(keys.event_status(keys.check_run_name(run)), enqueue)
        lost_at: float | None = None  # while nobody answers: when the run counts as gone
        run_uid = ""  # unknown until it answers
        try:
            while True:
                try:
                    document = self.document(run)
                except ConnectionFailedError:
                    lost_at = monotonic() + timeout if lost_at is None else lost_at
                    if monotonic() >= lost_at:
                        raise
                else:
                    lost_at, run_uid = None, str(document.get("run_uid", ""))
                    yield document
                    if document.get("state") in FINAL_STATES:
                        return
                wait = pause if lost_at is None else min(pause, max(lost_at - monotonic(), 0.0))
                if (last := take_final_status(last_statuses, run_uid, wait)) is not None:
                    yield last
                    return
        finally:
            subscriber.undeclare()

    def workers(self, run: str) -> list[WorkerStatus]:
        """All workers that the coordinator of `run` knows, lost ones included."""
        return list(self.fetch_rows("workers", WorkerStatus, run))

    def history(self, run: str, offset: int = 0) -> list[StoredGeneration]:
        """The closed generations of `run` after the first `offset`, oldest first."""
        return list(self.fetch_rows("history", StoredGeneration, run, offset))

    def events(
        self, run: str | None = None, worker: str = "", job: str = "", kinds: Collection[str] = ()
    ) -> tuple[list[Event], int]:
        """Recent events, oldest first, and the number of matching events that the coordinator keeps.

        An answer may hold fewer than that number. `worker` is a worker, or the host's name in its name; `job` is a
        candidate as generation/index; `kinds` are words of `status.EventKind`. Empty filters match all.
        """
        try:
            document = self.document(run, "story", f"worker={worker};job={job};what={','.join(kinds)}")
        except ConnectionFailedError:
            document = self.document(run)  # a worker's join file may read nothing else
        rows = document.get("story")
        if not isinstance(rows, list):
            raise MalformedError(
                f"the coordinator of run {document.get('run')} sends no events: a worker's join file may not read "
                "them, so use a viewer's"
            )
        rows, total = _read_page({"total": len(rows), **document}, "story")
        return [from_plain_lenient(Event, row) for row in rows], total

    def evaluations(self, run: str) -> list[StoredEvaluation]:
        """All finished evaluations of `run`, oldest first."""
        return list(self.fetch_rows("evaluations", StoredEvaluation, run))

    def candidates(self, run: str, generation: int) -> list[Population]:
        """All candidates of a generation, in parts: the open one, or the one before it; for others, the open one's."""
        parts: list[Population] = []
        seen = 0
        while not parts or seen < parts[0].total:
            document = self.document(run, "candidates", f"offset={seen};generation={generation}")
            parts.append(from_plain_lenient(Population, document))
            seen += len(parts[-1].done)
            if not parts[-1].done:
                break
        return parts

    def controller(self, run: str) -> Controller:
        """The controller that `run` reports now: its best evaluated mean, else the last mean.

        `ControllerError` before the first generation is closed.
        """
        for _ in range(MAX_RESTARTS):
            data, about = b"", self._fetch_controller_part(run, 0)
            sha256, total = about["sha256"], 4 * _check_total(about)
            while about["sha256"] == sha256:
                part = _decode_part(about)
                data += part
                if len(data) >= total or not part:
                    return _decode_controller(about, data)
                about = self._fetch_controller_part(run, len(data) // 4)
        raise ControllerError(f"the controller of run {run} changes faster than it can be fetched; ask again")

    def fetch_rows(self, part: str, kind: type[T], run: str, offset: int = 0) -> Iterator[T]:
        """The rows, of this `kind`, from `offset` on of a paged part: `workers`, `history` or `evaluations`."""
        while True:
            rows, total = _read_page(self.document(run, part, f"offset={offset}"), part)
            yield from (from_plain_lenient(kind, row) for row in rows)
            offset += len(rows)
            if offset >= total or not rows:
                return

    def control(self, run: str, verb: str, host: str = "") -> str:
        """Ask the coordinator to `pause`, `resume`, `drain` or `stop`, or to `bar` or `unbar` a host.

        `RefusedError` with its reason if it refuses. Returns the command that resumes the run on the coordinator's
        host, if it leaves and sends one; else empty.
        """
        about = f"?host={keys.check_worker_name(host)}" if host else ""
        for reply in self.session.get(keys.control(keys.check_run_name(run), verb) + about, timeout=QUERY_TIMEOUT):
            if reply.ok is not None:
                answer = read_answer(ControlReply, run, reply.ok.payload.to_bytes())
                if not answer.accepted:
                    raise RefusedError(answer.why)
                return answer.again
        raise self._no_answer_error(run)

    def _fetch_controller_part(self, run: str, offset: int) -> dict[str, Any]:
        about = self.document(run, "best", f"offset={offset}").get("controller")
        if about is None:
            raise ControllerError(f"run {run} reports no controller yet: wait until its first generation is closed")
        if not isinstance(about, dict) or not about.keys() >= {"sha256", "total", "parameters", "shape", "task"}:
            raise MalformedError(f"run {run} sends a controller that this version cannot read: update dreamfleet")
        return about

    def _no_answer_error(self, run: str | None) -> ConnectionFailedError:
        whose, again, others = "any run", "--run NAME` begins one", []
        if run:
            whose, again = f"run {run!r}", f"--resume {run} --runs-dir FOLDER` continues one that was stopped or killed"
            with suppress(DreamfleetError):
                others = [each for each in self.runs(NAMES_TIMEOUT) if each != run]
        right = ", or the join file gives no right to ask" if self._credentials else ""
        there = f"what is served there: {join_some(others, SHOWN_RUNS)}; " if others else ""
        return ConnectionFailedError(
            f"no coordinator of {whose} answers through {self._where}: it is not running{right}; {there}"
            f"`dreamfleet coordinator {again}"
        )

    def check_join_file(self) -> None:
        """`AccessError` if its join file has expired since: a router that ends such a link does not say why."""
        if self._credentials:
            self._credentials.check_time("the join file")

    def _query(self, selector: str) -> list[dict[str, Any]]:
        self.check_join_file()
        return [read_document(payload) for payload in query_all(self.session, [selector], QUERY_TIMEOUT)]


def take_final_status(statuses: queue.SimpleQueue[Any], run_uid: str, timeout: float) -> dict[str, Any] | None:
    """The status in which the coordinator of a run leaves, if one comes in `timeout` seconds.

    Anybody may publish at an open port, so other runs' statuses and what is no such status are passed over. An empty
    `run_uid` is that of any run.
    """
    deadline = monotonic() + timeout
    with suppress(queue.Empty):
        while True:
            _, sample = statuses.get(timeout=max(deadline - monotonic(), 0.0))
            with suppress(MalformedError):
                status = read_status(document := read_document(sample.payload.to_bytes()))
                if status.is_over and run_uid in ("", status.run_uid):
                    return document
    return None


def _read_page(document: dict[str, Any], part: str) -> tuple[list[Any], int]:
    """The rows of a page of a list, and how many the list has."""
    rows, total = document.get(part), document.get("total")
    if not isinstance(rows, list) or type(total) is not int:
        raise MalformedError(
            f"the coordinator of run {document.get('run')} sends no list of {part} that this version can read: install "
            "the same dreamfleet on both sides"
        )
    return rows, total


def _check_total(about: dict[str, Any]) -> int:
    """The number of parameters in a reply; `ControllerError` if no controller may have as many."""
    total = about["total"]
    if type(total) is not int or not 0 < total <= MAX_PARAMETERS:
        raise ControllerError(f"the run's controller has {total!r:.20} parameters: at most {MAX_PARAMETERS} are read")
    return total


def _decode_part(about: dict[str, Any]) -> bytes:
    """The parameters in one reply, as bytes."""
    try:
        return base64.b64decode(about["parameters"], validate=True)
    except (ValueError, TypeError) as error:
        raise ControllerError("the controller arrived damaged; ask again") from error


def _decode_controller(about: dict[str, Any], data: bytes) -> Controller:
    try:
        shape = from_plain_lenient(ControllerShape, about["shape"])
        parameters = np.frombuffer(data, dtype="<f4").astype(np.float32)
        controller = Controller(
            shape, parameters, str(about["task"]), str(about["bundle"]), dict(about.get("provenance", {})),
            str(about.get("options", "")), int(about.get("version", 1)),
        )  # fmt: skip
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise ControllerError(f"the run's controller cannot be read ({error}): update dreamfleet") from error
    if controller.sha256 != about["sha256"]:
        raise ControllerError("the controller arrived damaged; ask again")
    return controller


def read_answer(kind: type[T], run: str, payload: bytes) -> T:
    """What a coordinator answers to a command; `MalformedError` if its version is another one."""
    try:
        return decode_json(kind, payload)
    except MalformedError as error:
        raise MalformedError(
            f"the coordinator of run {run} has another version ({error}): install the same dreamfleet on both sides"
        ) from error
