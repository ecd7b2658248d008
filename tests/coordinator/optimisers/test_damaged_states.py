"""An optimiser's state out of a damaged journal: it is restored, or it is one line."""

import pytest

from dreamfleet.common.errors import JournalError
from dreamfleet.coordinator.optimisers.evolution import Evolution, EvolutionConfig
from tests.support.mutations import Watched, archives

COUNT = 50


@pytest.mark.parametrize("covariance", ["diagonal", "full"])
def test_damaged_states(covariance):
    config = EvolutionConfig(dimension=4, population=6, sigma0=0.5, covariance=covariance, seed=1)
    evolution = Evolution(config)
    for _ in range(3):
        evolution.tell((evolution.ask() ** 2).sum(axis=1))
    watched, restored = Watched(), 0
    for data in archives(evolution.state().packed(), COUNT, seed=8):
        restored += watched.read(JournalError, Evolution(config).restore, data)
    watched.check()
    assert 0 < restored < COUNT
