"""What an iteration's phases ask for."""

from pathlib import Path

from dreamfleet.experiments.iteration.config import IterateConfig
from dreamfleet.experiments.iteration.layout import IterationFolder
from dreamfleet.experiments.iteration.requests import Requests
from tests.support.ledgers import ledger

LAYOUT = IterationFolder(Path("data"))


def requests(*entries, **changes):
    return Requests(IterateConfig(**changes), LAYOUT, ledger(*entries))
