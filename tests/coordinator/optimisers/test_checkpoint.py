from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.errors import JournalError
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.coordinator.optimisers.checkpoint import Checkpoint
from dreamfleet.coordinator.optimisers.evolution import Evolution
from tests.support.mutations import Watched, archives

GOLDEN = Path(__file__).parents[1] / "golden"
STATE = "pycma-state-of-0.1.npz"


def test_a_state_of_the_first_version_continues_to_the_bit():
    state = (GOLDEN / STATE).read_bytes()
    head = Checkpoint.unpack(state).head
    assert (head.name, head.requirement, head.sigma) == ("cma", "cma==4.5.0", 0.13321928916395698)
    evolution = Evolution("cma", Search(np.zeros(3), 4, 0.1, seed=7))
    evolution.restore(state)
    assert np.array_equal(evolution.ask(), np.load(GOLDEN / "pycma-population-of-0.1.npy"))


def test_a_state_that_says_nothing_of_its_origin_is_refused():
    buffer = BytesIO()
    np.savez(buffer, numbers=np.arange(5))
    with pytest.raises(JournalError):
        Checkpoint.unpack(buffer.getvalue())


@pytest.mark.parametrize("covariance", ["diagonal", "full"])
def test_a_damaged_state_is_restored_or_is_one_line(covariance):
    search, count = Search(np.zeros(4), 6, 0.5, 1, {"covariance": covariance}), 50
    evolution = Evolution("cma", search)
    for _ in range(3):
        evolution.tell((evolution.ask() ** 2).sum(axis=1))
    watched, restored = Watched(), 0
    for data in archives(evolution.state().packed(), count, seed=8):
        restored += watched.read(JournalError, Evolution("cma", search).restore, data)
    watched.check()
    assert 0 < restored < count
