"""Answers of the `status` keys, cut from a snapshot of the run: JSON that stays under the message limit. Pure."""

import base64
import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from typing import Any, TypeVar

from dreamfleet.common.client.status import STATUS_SCHEMA_VERSION, Event, Population, Status, WorkerStatus
from dreamfleet.common.protocol.codec import encode_json
from dreamfleet.common.protocol.messages import MAX_MESSAGE
from dreamfleet.common.runs.records import StoredEvaluation, StoredGeneration, with_error
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.coordinator.dispatch.event_log import FleetEvent, latest
from dreamfleet.coordinator.jobs.generation import CandidateScores
from dreamfleet.coordinator.service.snapshot import Snapshot

PAGE_BYTES = 36_000  # of the rows of a page
PAGE, CANDIDATES = 100, 1000  # rows of a page, candidates of a page
HEAD_WORKERS, HEAD_HISTORY, HEAD_CANDIDATES = 11_000, 12_000, 6_000  # bytes of each list's first rows in the status
PARAMETERS = 4_000  # parameters of a controller in one answer: 21 KB in base64


T = TypeVar("T")
Row = TypeVar("Row", WorkerStatus, StoredGeneration, StoredEvaluation)


def encode_part(snapshot: Snapshot, part: str, get: Callable[[str], str | None]) -> bytes:
    """The JSON answer of a status key; the empty `part` is the whole status. `get` gives the query's parameters.

    Long parts come in pages from `offset` on, `best` with a slice of the controller's parameters, and `story` with as
    many of the last events as fit.
    """
    if part == "":
        return encode_status(snapshot)
    offset, limit = _number(get("offset"), 0), _number(get("limit"), 10**9)
    page = slice(offset, offset + min(limit, PAGE))
    history = snapshot.history.part(offset, min(limit, PAGE))
    documents: dict[str, Callable[[], dict[str, Any]]] = {
        "generation": lambda: _generation(snapshot),
        "workers": lambda: _page("workers", snapshot.workers[page], offset, len(snapshot.workers)),
        "history": lambda: _page("history", history, offset, len(snapshot.history)),
        "evaluations": lambda: _page(
            "evaluations", snapshot.evaluations[page], offset, len(snapshot.evaluations), with_error
        ),
        "candidates": lambda: _candidates(snapshot, get("generation"), offset, limit),
        "best": lambda: _best(snapshot, offset),
        "story": lambda: _story(snapshot, get),
    }
    head = {"schema": STATUS_SCHEMA_VERSION, "run": snapshot.status.run, "run_uid": snapshot.status.run_uid}
    return json.dumps({**head, **documents[part]()}, allow_nan=False).encode()


def encode_status(snapshot: Snapshot) -> bytes:
    """The status with the first rows of each list; fewer rows if the rest is unusually long."""
    share = 1.0
    while True:
        payload = _encode_with_errors(_with_heads(snapshot, share))
        if len(payload) <= MAX_MESSAGE or share < 0.01:
            return payload
        share /= 2


def _encode_with_errors(status: Status) -> bytes:
    """The document with the standard error of each score, which follows from its other fields."""
    plain = json.loads(encode_json(status))
    for name in ("evaluation", "best", "confirmed"):
        if (found := getattr(status, name)) is not None:
            plain[name] = with_error(found)
    return json.dumps(plain, allow_nan=False).encode()


def _with_heads(snapshot: Snapshot, share: float) -> Status:
    candidates = int(HEAD_CANDIDATES * share)
    whole = snapshot.full_status()
    return replace(
        whole,
        recent=tuple(reversed(_head(reversed(whole.recent), int(HEAD_HISTORY * share)))),
        worker_list=tuple(_head(whole.worker_list, int(HEAD_WORKERS * share))),
        population=_population(snapshot.candidate_scores, 0, CANDIDATES, candidates),
        last_population=None if snapshot.last is None else _population(snapshot.last, 0, CANDIDATES, candidates),
    )


def _generation(snapshot: Snapshot) -> dict[str, Any]:
    last = snapshot.status.last
    return {**asdict(snapshot.status.generation), "last": None if last is None else asdict(last)}


def _page(
    name: str, rows: Iterable[Row], offset: int, total: int, plain: Callable[[Row], dict[str, Any]] = asdict
) -> dict[str, Any]:
    return {"offset": offset, "total": total, name: [plain(each) for each in _head(rows, PAGE_BYTES)]}


def _candidates(snapshot: Snapshot, generation: str | None, offset: int, limit: int) -> dict[str, Any]:
    """Candidates of the open generation, or of the last closed one if `generation` is its number."""
    last = snapshot.last
    chosen = last if last is not None and generation == str(last.generation) else snapshot.candidate_scores
    return asdict(_population(chosen, offset, min(limit, CANDIDATES), PAGE_BYTES))


def _story(snapshot: Snapshot, get: Callable[[str], str | None]) -> dict[str, Any]:
    """The last events, the newest last: of a worker, a candidate's jobs (`generation/index`) or kinds, or all."""
    worker, what = get("worker") or "", get("what") or ""
    generation, slash, index = (get("job") or "").partition("/")
    chosen = (_number(generation, -1), _number(index, -1)) if slash else None
    found = list(latest(snapshot.event_log, worker, chosen, what.split(",") if what else ()))
    plain = (asdict(_event(each, snapshot.now)) for each in found)
    rows = _fitting(plain, PAGE_BYTES, lambda row: len(json.dumps(row)) + 2)
    return {"total": len(found), "story": rows[::-1]}


def _event(each: FleetEvent, now: float) -> Event:
    job = "" if each.job is None else "{} {}/{}/{}".format(*each.job)
    return Event(round(now - each.at, 3), each.what, each.worker, job, each.why)


def _best(snapshot: Snapshot, offset: int) -> dict[str, Any]:
    """The best evaluation and the reported controller, with its parameters from `offset` on."""
    best, reported = snapshot.status.best, snapshot.reported
    document = {"best": None if best is None else with_error(best), "evaluations": snapshot.status.evaluations}
    confirmed = snapshot.status.confirmed
    document["confirmed"] = None if confirmed is None else with_error(confirmed)
    if reported is None:
        return {**document, "controller": None}
    controller = reported.controller()
    part = controller.parameters[offset : offset + PARAMETERS].astype("<f4").tobytes()
    about = {
        "shape": to_plain(controller.shape),
        "task": controller.task,
        "bundle": controller.bundle,
        "provenance": controller.provenance,
        "options": controller.options,
        "version": controller.version,
        "sha256": controller.sha256,  # of all parameters: a client checks that its parts belong together
        "dtype": "<f4",
        "offset": offset,
        "total": len(controller.parameters),
        "parameters": base64.b64encode(part).decode(),
    }
    return {**document, "controller": about}


def _population(candidate_scores: CandidateScores, offset: int, limit: int, size: int) -> Population:
    """At most `limit` candidates from `offset` on, about `size` bytes of JSON at most."""
    part = slice(offset, offset + limit)
    columns = zip(
        candidate_scores.done[part], candidate_scores.wanted[part], candidate_scores.fitness[part], strict=True
    )
    rows = _fitting(columns, size, lambda row: len(json.dumps(row)) + 4)
    done, wanted, fitness = zip(*rows, strict=True) if rows else ((), (), ())
    return Population(candidate_scores.generation, offset, len(candidate_scores.done), done, wanted, fitness)


def _head(rows: Iterable[Row], size: int) -> list[Row]:
    """The first rows, `size` bytes of JSON at most."""
    return _fitting(rows, size, lambda row: len(json.dumps(asdict(row))) + 2)


def _fitting(rows: Iterable[T], size: int, measure: Callable[[T], int]) -> list[T]:
    """As many of the first rows as fit into `size` bytes, but at least one."""
    kept: list[T] = []
    for row in rows:
        size -= measure(row)
        if size < 0 and kept:
            break
        kept.append(row)
    return kept


def _number(text: str | None, default: int) -> int:
    return int(text) if text is not None and text.isdecimal() and len(text) < 19 else default
