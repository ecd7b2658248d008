"""The commands of an iteration's phases."""

from pathlib import Path

from dreamfleet.experiments.iteration.commands import Commands
from dreamfleet.experiments.iteration.config import IterateConfig
from dreamfleet.experiments.iteration.layout import IterationFolder
from tests.support.ledgers import ledger

LAYOUT = IterationFolder(Path("data"))


def commands(*entries, **changes):
    return Commands(IterateConfig(**changes), LAYOUT, ledger(*entries))
