from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.errors import JournalError
from dreamfleet.coordinator.optimisers.checkpoint import Checkpoint, Head
from dreamfleet.coordinator.optimisers.evolution import Evolution, EvolutionConfig

GOLDEN = Path(__file__).parents[1] / "golden"
CONFIG = EvolutionConfig(dimension=3, population=4, sigma0=0.1, covariance="diagonal", seed=7)
STATE = "pycma-state-of-0.1.npz"


def test_a_state_of_the_first_version_continues_to_the_bit():
    evolution = Evolution(CONFIG)
    evolution.restore((GOLDEN / STATE).read_bytes())
    assert np.array_equal(evolution.ask(), np.load(GOLDEN / "pycma-population-of-0.1.npy"))


def test_a_state_of_the_first_version_holds_mean_and_step_size():
    head = Checkpoint.unpack((GOLDEN / STATE).read_bytes()).head
    assert head.name == "cma"
    assert head.requirement == "cma==4.5.0"
    assert np.allclose(head.mean, [0.14175252, 0.38951298, 0.20032745])
    assert head.sigma == 0.13321928916395698


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
