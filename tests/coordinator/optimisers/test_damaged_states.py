"""An optimiser's state out of a damaged journal: it is restored, or it is one line."""

import numpy as np
import pytest

from dreamfleet.common.errors import JournalError
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.coordinator.optimisers.evolution import Evolution
from tests.support.mutations import Watched, archives

COUNT = 50


@pytest.mark.parametrize("covariance", ["diagonal", "full"])
def test_damaged_states(covariance):
    search = Search(np.zeros(4), 6, 0.5, 1, {"covariance": covariance})
    evolution = Evolution("cma", search)
    for _ in range(3):
        evolution.tell((evolution.ask() ** 2).sum(axis=1))
    watched, restored = Watched(), 0
    for data in archives(evolution.state().packed(), COUNT, seed=8):
        restored += watched.read(JournalError, Evolution("cma", search).restore, data)
    watched.check()
    assert 0 < restored < COUNT
