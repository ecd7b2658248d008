"""Comparison of recorded scores with those of the same episodes repeated."""

from dataclasses import astuple, dataclass
from functools import cached_property
from itertools import starmap

from dreamfleet.common.addons.evaluation_report import EvaluationReport, contradicts, differing_facts
from dreamfleet.common.printable import format_number, one_line, plural
from dreamfleet.common.runs.episode_results import EpisodeResult, EpisodeResults
from dreamfleet.common.runs.paired_difference import PairedDifference


@dataclass(frozen=True)
class Reproduction:
    """A recorded report, and a new one of the same controller on all or some of its seeds.

    What the record states of controller and world must hold; what it leaves empty, it does not state. On a host of the
    recorded fingerprint every episode must be bit-identical. On other hosts the mean may differ by two standard errors
    of the paired difference, on as many seeds as `is_decided` needs; a single episode must be bit-identical there too.
    """

    recorded: EvaluationReport
    repeated: EvaluationReport

    @cached_property
    def pairs(self) -> tuple[tuple[EpisodeResult, EpisodeResult], ...]:
        """Each repeated episode with its record, which comes first."""
        before = {each.seed: each for each in self.recorded.drives}
        return tuple((before[each.seed], each) for each in self.repeated.drives)

    @property
    def same_fingerprint(self) -> bool:
        """Whether the hosts' fingerprints are equal, so that equal bits are expected."""
        return self.recorded.fingerprint == self.repeated.fingerprint

    @property
    def differing_facts(self) -> tuple[str, ...]:
        """What the record states of controller and world, and what is another now."""
        return differing_facts(self.recorded, self.repeated.facts)

    @property
    def differing_seeds(self) -> tuple[int, ...]:
        """The seeds whose score, number of steps or another recorded figure differs, or which fail now."""
        differing = {
            one.seed for one, other in self.pairs
            if any(starmap(contradicts, zip(astuple(one), astuple(other), strict=True)))
        }  # fmt: skip
        return tuple(sorted(differing | {each.seed for each in self.repeated.failed}))

    @property
    def difference(self) -> PairedDifference:
        """The new scores minus the recorded ones; `UsageError` for a single seed."""
        return PairedDifference.between(self._compared, self.repeated.results)

    @property
    def _difference_text(self) -> str:
        return self.difference.describe(minimised=self.repeated.results.minimised)

    @property
    def _compared(self) -> EpisodeResults:
        return EpisodeResults(tuple(one for one, _ in self.pairs))

    @property
    def is_decided(self) -> bool:
        """Whether bits decide, or the seeds: they differ significantly, or would by one new standard deviation.

        The recorded deviation has no say: who invents scores chooses it.
        """
        if self.same_fingerprint or not self.differing_seeds:
            return True
        if len(self.pairs) < 2:
            return False
        found, deviation = self.difference, self.repeated.results.std or 0.0
        return found.is_significant or found.critical_value * found.error <= deviation

    @property
    def is_reproduced(self) -> bool:
        """Whether the record is reproduced."""
        if self.differing_facts:
            return False
        if not self.differing_seeds:
            return True
        return (
            not self.repeated.failed
            and not self.same_fingerprint
            and self.is_decided
            and not self.difference.is_significant
        )

    @property
    def description(self) -> str:
        """A text for display."""
        results = self.repeated.results
        name, count, mean = self.recorded.name, len(self.pairs), results.shown(results.mean)
        failed = len(self.recorded.failed)
        if self.differing_facts:
            first = self.differing_facts[0]
            was, now = (one_line(str(getattr(each, first))) or "none" for each in (self.recorded, self.repeated))
            return f"{name}: NOT reproduced: the report says {first} {was}, and it is {now}"
        if self.repeated.failed:
            now = self.repeated.results.failure_text
            return f"{name}: NOT reproduced: {now}; all had a score when they were recorded"
        if not self.differing_seeds:
            host = "" if self.same_fingerprint else ", although this host has another fingerprint"
            left = f"; {plural(failed, 'episode')} that had failed: not driven again" if failed else ""
            return f"{name}: reproduced: {plural(count, 'bit-identical score')}, mean {format_number(mean)}{host}{left}"
        if self.same_fingerprint:
            seeds = ", ".join(map(str, self.differing_seeds[:5])) + (", ..." if len(self.differing_seeds) > 5 else "")
            return (
                f"{name}: NOT reproduced: {len(self.differing_seeds)} of {plural(count, 'drive')} differ (seeds "
                f"{seeds}) on a "
                f"host of the recorded fingerprint; it was recorded by dreamfleet {self.recorded.version}, here is "
                f"{self.repeated.version}"
            )
        hosts = f"recorded on [{self.recorded.fingerprint}], this host is [{self.repeated.fingerprint}]"
        if count < 2:
            was = f"{format_number(mean)} instead of {format_number(results.shown(self.pairs[0][0].score))}"
            return f"{name}: NOT reproduced: {was} on one seed; without equal bits a comparison takes 2 seeds; {hosts}"
        if not self.is_decided:
            said = f"mean {format_number(mean)}, {self._difference_text}"
            return f"{name}: not decided: {said}; compare more seeds; {hosts}"
        verdict = "reproduced" if self.is_reproduced else "NOT reproduced"
        return f"{name}: {verdict}: mean {format_number(mean)}, {self._difference_text}; {hosts}"
