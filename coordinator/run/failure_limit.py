"""Whether so many candidates failed that a run must pause (R8)."""

from __future__ import annotations

from contextlib import suppress

from dreamfleet.common.printable import plural
from dreamfleet.coordinator.jobs.generation import Generation
from dreamfleet.coordinator.run.generations import Generations
from dreamfleet.coordinator.storage.journal import Journal

LIMIT_FROM = "limit_from"  # the fact that names the first generation whose failures count


def forget_acceptance(journal: Journal, generation: int) -> None:
    """Let failures count again from this generation on, which is open again: what was accepted came after it."""
    with suppress(ValueError):
        if int(journal.fact(LIMIT_FROM) or 0) > generation + 1:
            journal.drop_fact(LIMIT_FROM)


class FailureLimit:
    """At most the share `share` of the last generations' candidates may fail; `generations` counts them."""

    def __init__(self, journal: Journal, generations: Generations, share: float) -> None:
        self.share = share
        self._journal = journal
        self._generations = generations
        self._since = 0
        with suppress(ValueError):  # of a damaged journal: then all generations count
            self._since = int(journal.fact(LIMIT_FROM) or 0)

    def accept(self, generation: int) -> None:
        """Count failures from the next generation on: somebody resumed the run."""
        self._since = generation + 1
        self._journal.set_fact(LIMIT_FROM, str(self._since))

    def find_excess(self, generation: Generation) -> str | None:
        """What failed so often that the run pauses, in words; `None` if nothing did."""
        if self._generations.is_external:
            return None  # who submits the candidates sees what fails
        if generation.all_failed and not self._generations.can_try_again(generation):
            return (
                f"all candidates failed in generation {generation.number} on each set of seeds, so that none can be "
                "ranked; `dreamfleet resume` tries them again, `dreamfleet coordinator --from` begins another run at "
                "the mean"
            )
        failed, counted = self._generations.count_recent_failures(generation, self._since)
        total = len(counted) * generation.population
        if failed > self.share * total:
            first, last = counted[0], counted[-1]
            where = f"generation {last}" if first == last else f"generations {first} to {last}"
            return (
                f"{failed} of {plural(total, 'candidate')} failed in {where}; `dreamfleet resume` tries them again and "
                "continues, however many fail in this generation"
            )
        return None
