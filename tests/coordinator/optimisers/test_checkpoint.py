from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.errors import JournalError
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.coordinator.optimisers.checkpoint import Checkpoint
from dreamfleet.coordinator.optimisers.evolution import Evolution

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
