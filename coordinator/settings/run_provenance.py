"""Drawing up the receipt of a run's controller, from what its journal holds at that moment. Pages: export.md."""

import platform
from functools import cache

from dreamfleet.common.host.packages import package_version
from dreamfleet.common.protocol.check_counts import CheckCounts
from dreamfleet.common.runs.effort import START_EFFORT, parse_start_effort
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.run_provenance import RunProvenance, StartProvenance, validation_seed_ranges
from dreamfleet.coordinator.settings.start import START_MEAN, START_SOURCE, SUBSPACE_FACT
from dreamfleet.coordinator.storage.journal import Journal

DECIDING_PACKAGES = ("dreamfleet", "numpy", "cma", "cmaes")  # packages whose versions decide what is asked for


def build_provenance(
    journal: Journal, settings: RunSettings, generations: int, failed: int, checks: CheckCounts | None = None
) -> RunProvenance:
    """The receipt of a run that has closed so many generations, in which so many candidates `failed`.

    It costs the same however long the run is.
    """
    classes = journal.results.classes
    return RunProvenance(
        generations, journal.results.effort, _start(journal), journal.fingerprint(), classes.mixed, versions(),
        validation_seed_ranges(settings), journal.fact(SUBSPACE_FACT), classes, failed, checks,
    )  # fmt: skip


def _start(journal: Journal) -> StartProvenance | None:
    source, mean = journal.fact(START_SOURCE), journal.fact(START_MEAN)
    if source is None or mean is None:
        return None
    return StartProvenance.of(source, mean, parse_start_effort(journal.fact(START_EFFORT)))


@cache
def versions() -> dict[str, str]:
    """Of what a coordinator computes with, on this host."""
    found = {name: package_version(name) for name in DECIDING_PACKAGES}
    return {"python": platform.python_version(), **{name: each for name, each in found.items() if each is not None}}
