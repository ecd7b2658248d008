"""Ledgers of iterations, and what their phases ask for."""

from pathlib import Path

from dreamfleet.experiments.iteration.config import IterateConfig
from dreamfleet.experiments.iteration.layout import IterationFolder
from dreamfleet.experiments.iteration.ledger import FinishedPhase, IterationLedger
from dreamfleet.experiments.iteration.requests import Requests

RUN = {"task": "dream", "population": 64, "collect_every": 0, "stages": ()}
LAYOUT = IterationFolder(Path("data"))


def entry(number, phase, made=(), **figures):
    return FinishedPhase(
        number, phase, 0, 1.5, "2026-01-01T00:00:00+00:00", ({"request": "EncodeRequest"},), figures, tuple(made)
    )


def ledger(*entries):
    found = IterationLedger.begin(IterateConfig(), RUN)
    for each in entries:
        found = found.add(each)
    return found


def requests(*entries, **changes):
    return Requests(IterateConfig(**changes), LAYOUT, ledger(*entries))
