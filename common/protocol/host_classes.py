"""Host classes: hosts of one class computed the same bits on fixed inputs. No input or output.

A worker computes its class by scoring these inputs (`worker/scoring/host_class_probe.py`) and sends it with its
results. For tasks without such inputs the class is derived from the host's fingerprint. Pages: determinism.md.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from dreamfleet.common.printable import plural, printable, truncate
from dreamfleet.common.protocol.messages import HostClass
from dreamfleet.common.schema.validation import Count, Text

BY_FINGERPRINT = "fingerprint-"  # prefix of classes that are derived from a fingerprint
NON_DETERMINISTIC = "non-deterministic"  # the class of a host where equal episodes gave other bits
MAX_LISTED = 4  # classes in a status, and fingerprints of each class (docs/reference/metrics.md)
MAX_FINGERPRINT_CHARS = 200  # of a fingerprint in a status

ResultCounts = Mapping[tuple[str, str], int]
"""Numbers of accepted results by class and fingerprint."""


@dataclass(frozen=True)
class HostClassShare:
    """One class's share of the accepted results."""

    host_class: HostClass
    results: Count
    fingerprints: Annotated[tuple[Text, ...], Meta(max_length=MAX_LISTED)]  # the most frequent ones of its hosts


@dataclass(frozen=True)
class HostClasses:
    """The host classes of a run's accepted results: their number, and the `MAX_LISTED` largest, the largest first."""

    total: Count = 0
    largest: Annotated[tuple[HostClassShare, ...], Meta(max_length=MAX_LISTED)] = ()
    results: Count = 0  # of all classes

    @classmethod
    def of(cls, counted: ResultCounts) -> HostClasses:
        """From the numbers of results by class and fingerprint."""
        sizes: Counter[str] = Counter()
        for (host_class, _), results in counted.items():
            sizes[host_class] += results
        largest = tuple(
            HostClassShare(host_class, results, _fingerprints(counted, host_class))
            for host_class, results in sorted(sizes.items(), key=lambda each: (-each[1], each[0]))[:MAX_LISTED]
        )
        return cls(len(sizes), largest, sum(sizes.values()))

    @property
    def mixed(self) -> bool:
        """Whether hosts of several classes scored."""
        return self.total > 1

    @property
    def varying(self) -> int:
        """The number of results that no host can recompute to the bit, as far as they are listed."""
        return sum(each.results for each in self.largest if each.host_class == NON_DETERMINISTIC)

    @property
    def description(self) -> str:  # docs/reference/status.md has these words
        """A text for display."""
        if not self.largest:
            return "no result yet"
        if self.varying:
            share = self.varying / max(self.results, 1)
            return f"not deterministic: {share:.1%} of the results are not bit-identical when recomputed"
        if not self.mixed:
            by = " (by fingerprint)" if self.largest[0].host_class.startswith(BY_FINGERPRINT) else ""
            return f"one class{by}: all results are bit-identical"
        shares = ", ".join(f"{each.results / max(self.results, 1):.1%}" for each in self.largest)
        more = f" and {self.total - len(self.largest)} more" if self.total > len(self.largest) else ""
        return f"mixed: {self.total} classes with {shares}{more} of the results"

    @property
    def rows(self) -> list[tuple[str, str]]:
        """Each listed class, and a text of its results and hosts."""
        hosts = ((each, ", ".join(f"[{printable(name)}]" for name in each.fingerprints)) for each in self.largest)
        return [(printable(each.host_class), f"{plural(each.results, 'result')} of {names}") for each, names in hosts]


def count_results(rows: Iterable[tuple[str, str, int]]) -> Counter[tuple[str, str]]:
    """Count results by class and fingerprint from a journal's rows of both and their count."""
    return Counter({(host_class, fingerprint): results for host_class, fingerprint, results in rows})


def class_from_fingerprint(fingerprint: str) -> str:
    """The class of a host of which only the fingerprint is known."""
    return BY_FINGERPRINT + hashlib.sha256(fingerprint.encode()).hexdigest()[:12]


def effective_class(reported: str, fingerprint: str, run: str | None) -> str:
    """The class under which a host counts in a run; empty if it is not known yet.

    `reported` is the class that the host reported, empty if not known yet. `run` is the class of the run's first
    result. If that was derived from a fingerprint, all classes of the run are.
    """
    return class_from_fingerprint(fingerprint) if (run or "").startswith(BY_FINGERPRINT) else reported


def _fingerprints(counted: ResultCounts, host_class: str) -> tuple[str, ...]:
    own = Counter({fingerprint: results for (each, fingerprint), results in counted.items() if each == host_class})
    return tuple(truncate(fingerprint, MAX_FINGERPRINT_CHARS) for fingerprint, _ in own.most_common(MAX_LISTED))
