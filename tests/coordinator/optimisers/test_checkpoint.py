from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.errors import JournalError
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.coordinator.optimisers.checkpoint import Checkpoint, Head
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


def test_what_is_read_is_what_was_packed():
    state = {"numbers": np.arange(5), "text": np.array("words"), "mean": np.zeros(2)}
    read = Checkpoint.unpack(Checkpoint(Head("mine", "mine==1", np.ones(2), 0.5), state).packed())
    assert (read.head.name, read.head.requirement, read.head.sigma) == ("mine", "mine==1", 0.5)
    assert np.array_equal(read.head.mean, np.ones(2))
    assert read.state.keys() == state.keys()
    assert all(np.array_equal(read.state[name], array) for name, array in state.items())


def test_a_state_that_says_nothing_of_its_origin_is_refused():
    kept = Checkpoint(Head("mine", "mine==1", np.ones(2), 0.5), {})
    with pytest.raises(JournalError):
        Checkpoint.unpack(_without_head(kept.packed()))


def _without_head(packed):
    import io

    with np.load(io.BytesIO(packed)) as archive:
        kept = {name: archive[name] for name in archive if not name.startswith("optimiser.")}
    buffer = io.BytesIO()
    np.savez(buffer, **kept)
    return buffer.getvalue()
