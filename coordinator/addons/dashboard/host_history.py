"""What each host of a run did over time, from what its journal keeps: results, generations' times and events. Pure.

The journal keeps no moment of a result, so a result counts evenly over the time in which its generation was scored. It
keeps no number of slots either: what is known is the slot time of results, and how many workers were there.

`page/hosts.js` shows it.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.printable import printable
from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.runs.records import StoredEvent, WorkerEffort

BINS = 120  # of the run's time
MOST_HOSTS = 200  # in the document; the others are summed
MOST_EVENTS = 200  # the latest arrivals and departures
Times = Mapping[int, tuple[float, float | None]]  # by generation: opened and closed
_CAME, _GONE = ("joined", "back"), ("silent", "lost", "left")  # what becomes of a worker: dispatch/event_log.py


@dataclass
class _Host:
    lives: set[str] = field(default_factory=set)  # workers: processes of its name
    results: int = 0
    steps: float = 0.0
    seconds: float = 0.0
    binned_steps: NDArray[np.float64] = field(default_factory=lambda: np.zeros(BINS))
    present: list[tuple[float, float]] = field(default_factory=list)


def host_history(
    work: Sequence[WorkerEffort], times: Times, events: Sequence[StoredEvent], until: float | None
) -> dict[str, Any]:
    """The JSON document; `until` is the run's end, or now if it is live, in seconds since 1970; `None`: unknown."""
    moments = [each for pair in times.values() for each in pair if each is not None]
    moments += [each.happened for each in events]
    if not moments:
        return {"since": None, "width": 0.0, "hosts": [], "events": []}
    since, end = min(moments), max(moments) if until is None else max(until, min(moments))
    width = max(end - since, 1.0) / BINS
    hosts: dict[str, _Host] = {}
    spans = _Spans(work, times, end)
    for each in work:
        host = hosts.setdefault(host_of(each.worker), _Host())
        host.lives.add(each.worker)
        host.results += each.results
        host.steps += each.steps
        host.seconds += each.seconds
        host.binned_steps += each.steps * _shares(*spans(each), since, width)
    for worker, came, went in _stays(events, sorted(moments), end):
        host = hosts.setdefault(host_of(worker), _Host())
        host.lives.add(worker)
        host.present.append((came, went))
    ordered = sorted(hosts.items(), key=lambda each: (-each[1].steps, each[0]))
    return {
        "since": since,
        "width": width,
        "hosts": [_row(name, each, since, width) for name, each in ordered[:MOST_HOSTS]],
        "more": max(len(ordered) - MOST_HOSTS, 0),
        "events": [
            {"at": each.happened, "text": printable(each.text)} for each in events if each.what in (*_CAME, *_GONE)
        ][: -MOST_EVENTS - 1 : -1],
    }


class _Spans:
    """When work was done, as far as the journal says: from and until."""

    def __init__(self, work: Sequence[WorkerEffort], times: Times, end: float) -> None:
        self._times, self._end = times, end
        self._last = max((closed for _, closed in times.values() if closed is not None), default=end)
        self._besides = sorted({each.generation for each in work if each.kind != "score" and not each.confirming})

    def __call__(self, work: WorkerEffort) -> tuple[float, float]:
        """Candidates: while their generation was open. A mean: in idle slots, until the next one's turn."""
        if work.confirming:
            return self._last, self._end
        opened, closed = self._times.get(work.generation, (self._end, None))
        if work.kind == "score":
            return opened, self._end if closed is None else closed
        following = bisect_right(self._besides, work.generation)
        until = None
        if following < len(self._besides):
            until = self._times.get(self._besides[following], (self._end, None))[1]
        return opened if closed is None else closed, self._end if until is None else until


def _shares(began: float, ended: float, since: float, width: float) -> NDArray[np.float64]:
    """The share of a span in each bin `(BINS,)`; they add up to 1."""
    first = min(max((began - since) / width, 0.0), BINS - 1e-9)
    last = min(max((ended - since) / width, first + 1e-9), float(BINS))
    edges = np.arange(BINS + 1.0)
    inside: NDArray[np.float64] = np.minimum(edges[1:], last) - np.maximum(edges[:-1], first)
    return inside.clip(0.0) / (last - first)


def _stays(events: Sequence[StoredEvent], moments: Sequence[float], end: float) -> Iterator[tuple[str, float, float]]:
    """From when to when each worker was there."""
    here: dict[str, float] = {}
    incarnation = None
    for each in events:
        if each.incarnation != incarnation:  # its coordinator ended: the last sign of it is what the journal has
            incarnation = each.incarnation
            last = moments[max(bisect_left(moments, each.happened) - 1, 0)]
            yield from ((worker, came, max(last, came)) for worker, came in here.items())
            here.clear()
        if each.what in _CAME:
            here.setdefault(each.worker, each.happened)
        elif each.what in _GONE and each.worker in here:
            came = here.pop(each.worker)
            yield each.worker, came, max(each.happened, came)
    yield from ((worker, came, max(end, came)) for worker, came in here.items())


def _covered(present: Sequence[tuple[float, float]]) -> float:
    """Seconds in which at least one worker was there."""
    seconds, reached = 0.0, float("-inf")
    for came, went in sorted(present):
        seconds += max(went - max(came, reached), 0.0)
        reached = max(reached, went)
    return seconds


def _row(name: str, host: _Host, since: float, width: float) -> dict[str, Any]:
    counts = np.zeros(BINS)  # workers that were there, on average in each bin
    for came, went in host.present:
        counts += (went - came) / width * _shares(came, went, since, width)
    return {
        "host": printable(name), "lives": len(host.lives), "results": host.results, "steps": host.steps,
        "seconds": host.seconds, "rate": [float(f"{each / width:.4g}") for each in host.binned_steps.tolist()],
        "there": _covered(host.present), "workers": [float(f"{each:.3g}") for each in counts.tolist()],
        "present": host.present,
    }  # fmt: skip
