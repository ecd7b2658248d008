"""Drawing up the receipt of a run's controller, from what its journal holds at that moment."""

from __future__ import annotations

import platform
from functools import cache

from dreamfleet.common.effort import START_EFFORT, start_effort
from dreamfleet.common.fingerprint import package_version
from dreamfleet.common.receipt import Receipt, StartReceipt, validation_uses
from dreamfleet.common.stored import RunSettings
from dreamfleet.coordinator.journal import Journal
from dreamfleet.coordinator.start import MEAN, SOURCE, SUBSPACE

DECIDING = ("dreamfleet", "numpy", "cma", "cmaes")  # packages whose versions decide what is asked for


def draw_up(journal: Journal, settings: RunSettings, generations: int) -> Receipt:
    """The receipt of a run that has closed so many generations. It costs the same however long the run is."""
    return Receipt(
        generations, journal.effort, _start(journal), journal.fingerprint(), journal.classes.mixed, versions(),
        validation_uses(settings), journal.fact(SUBSPACE), journal.classes,
    )  # fmt: skip


def _start(journal: Journal) -> StartReceipt | None:
    """Where the run began; `None` also for a journal from before the mean was kept."""
    source, mean = journal.fact(SOURCE), journal.fact(MEAN)
    if source is None or mean is None:
        return None
    return StartReceipt.of(source, mean, start_effort(journal.fact(START_EFFORT)))


@cache
def versions() -> dict[str, str]:
    """Of what a coordinator computes with, on this host."""
    found = {name: package_version(name) for name in DECIDING}
    return {"python": platform.python_version(), **{name: each for name, each in found.items() if each is not None}}
