"""Classes of hosts: those of one class compute the same bits, as far as fixed inputs show it. Pure.

A worker finds out its class by scoring (`worker/scoring/host_class_probe.py`) and sends it with its results. A worker
from before there were classes, and a task that cannot be probed, are classed by the host's fingerprint: by what the
host says of itself instead of what it computes.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated

from dreamfleet.common.printable import printable, truncate
from dreamfleet.common.protocol.messages import HostClass
from dreamfleet.common.serialization.constraints import Count, Length, Text

BY_FINGERPRINT = "fingerprint-"  # how a class begins that nothing but a fingerprint tells
MAX_LISTED = 4  # classes of a status, and fingerprints of each
MAX_FINGERPRINT_CHARS = 200  # characters of a fingerprint there

ResultCounts = Mapping[tuple[str, str], int]
"""Accepted results by class and fingerprint."""


@dataclass(frozen=True)
class HostClassShare:
    """The accepted results of one class's hosts."""

    host_class: HostClass
    results: Count
    fingerprints: Annotated[tuple[Text, ...], Length(0, MAX_LISTED)]  # of these hosts, the most frequent ones


@dataclass(frozen=True)
class HostClasses:
    """What a run's accepted results are of: the largest classes first, at most `MOST_TOLD`, of so many."""

    total: Count = 0
    largest: Annotated[tuple[HostClassShare, ...], Length(0, MAX_LISTED)] = ()
    results: Count = 0  # of all classes

    @classmethod
    def of(cls, counted: ResultCounts) -> HostClasses:
        """From results by class and fingerprint."""
        sizes: Counter[str] = Counter()
        for (host_class, _), results in counted.items():
            sizes[host_class] += results
        largest = tuple(
            HostClassShare(host_class, results, _fingerprints(counted, host_class))
            for host_class, results in sizes.most_common(MAX_LISTED)
        )
        return cls(len(sizes), largest, sum(sizes.values()))

    @property
    def mixed(self) -> bool:
        """Whether hosts whose bits differ have scored."""
        return self.total > 1

    @property
    def description(self) -> str:
        """In words."""
        if not self.largest:
            return "no result yet"
        if not self.mixed:
            by = ", by its fingerprint" if self.largest[0].host_class.startswith(BY_FINGERPRINT) else ""
            return f"one class{by}: to the bit"
        shares = ", ".join(f"{each.results / max(self.results, 1):.1%}" for each in self.largest)
        more = f" and {self.total - len(self.largest)} more" if self.total > len(self.largest) else ""
        return f"mixed: {self.total} classes, {shares}{more} of results"

    @property
    def rows(self) -> list[tuple[str, str]]:
        """Each class with its results and hosts, in words."""
        return [(printable(each.host_class), _describe_hosts(each)) for each in self.largest]


def count(rows: Iterable[tuple[str, str, int]]) -> Counter[tuple[str, str]]:
    """Results by class and fingerprint, of a journal's rows: where a class is empty the fingerprint tells it."""
    counted: Counter[tuple[str, str]] = Counter()
    for host_class, fingerprint, results in rows:
        counted[host_class or class_from_fingerprint(fingerprint), fingerprint] += results
    return counted


def class_from_fingerprint(fingerprint: str) -> str:
    """The class of a host that says nothing but its fingerprint."""
    return BY_FINGERPRINT + hashlib.sha256(fingerprint.encode()).hexdigest()[:12]


def effective_class(said: str | None, fingerprint: str, run: str | None) -> str:
    """What a host of this fingerprint counts as that `said` its class, where the first result's class is `run`.

    `None` says nothing, an empty text that the class is not known yet: then neither is this, unless the run's first
    result was classed by its fingerprint, as results from before classes are. Such a run goes on by fingerprints.
    """
    if said is None or (run or "").startswith(BY_FINGERPRINT):
        return class_from_fingerprint(fingerprint)
    return said


def _fingerprints(counted: ResultCounts, host_class: str) -> tuple[str, ...]:
    own = Counter({fingerprint: results for (each, fingerprint), results in counted.items() if each == host_class})
    return tuple(truncate(fingerprint, MAX_FINGERPRINT_CHARS) for fingerprint, _ in own.most_common(MAX_LISTED))


def _describe_hosts(each: HostClassShare) -> str:
    hosts = [f"[{printable(fingerprint)}]" for fingerprint in each.fingerprints]
    return f"{each.results:,} results of {', '.join(hosts)}"
