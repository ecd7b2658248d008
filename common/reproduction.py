"""Recorded scores and the same drives again: whether they agree."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from dreamfleet.common.difference import Difference
from dreamfleet.common.evaluated import Drive, Evaluated
from dreamfleet.common.judgement import Judgement


@dataclass(frozen=True)
class Reproduction:
    """A recorded report, and what its controller drove now, on the same seeds or on some of them.

    On a host of the recorded fingerprint every drive must be the same to the bit, and so must a single one anywhere.
    Elsewhere the mean may differ by two standard errors of the paired difference.
    """

    recorded: Judgement
    again: Judgement

    @cached_property
    def pairs(self) -> tuple[tuple[Drive, Drive], ...]:
        """Each drive as it was recorded, and again."""
        before = {each.seed: each for each in self.recorded.drives}
        return tuple((before[each.seed], each) for each in self.again.drives)

    @property
    def same_host(self) -> bool:
        """Whether equal bits are expected."""
        return self.recorded.fingerprint == self.again.fingerprint

    @property
    def differing(self) -> tuple[int, ...]:
        """The seeds whose score or length is another."""
        return tuple(one.seed for one, other in self.pairs if (one.score, one.steps) != (other.score, other.steps))

    @property
    def difference(self) -> Difference:
        """Of now less the record; `UsageError` of a single seed."""
        return Difference.between(Evaluated(tuple(one for one, _ in self.pairs)), self.again.evaluated)

    @property
    def holds(self) -> bool:
        """Whether the record is reproduced."""
        return not self.differing or (not self.same_host and len(self.pairs) > 1 and not self.difference.clear)

    @property
    def told(self) -> str:
        """In words."""
        name, count, mean = self.recorded.name, len(self.pairs), self.again.evaluated.mean
        if not self.differing:
            host = "" if self.same_host else ", though this host is of another fingerprint"
            return f"{name}: reproduced: the same {count} scores to the bit, mean {mean:.1f}{host}"
        if self.same_host:
            seeds = ", ".join(map(str, self.differing[:5])) + (", ..." if len(self.differing) > 5 else "")
            return (
                f"{name}: NOT reproduced: {len(self.differing)} of {count} drives differ (seeds {seeds}) on a host of "
                f"the recorded fingerprint; it was recorded by dreamfleet {self.recorded.version}, here is "
                f"{self.again.version}"
            )
        hosts = f"recorded on [{self.recorded.fingerprint}], this host is [{self.again.fingerprint}]"
        if count < 2:
            was = f"{mean:.1f} instead of {self.pairs[0][0].score:.1f}"
            return f"{name}: NOT reproduced: {was} on one seed, and a mean of other bits takes 2 seeds or more; {hosts}"
        return f"{name}: {'' if self.holds else 'NOT '}reproduced: mean {mean:.1f}, {self.difference.told}; {hosts}"
