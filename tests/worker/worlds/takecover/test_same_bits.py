"""The real game gives equal bits for equal seeds and actions, wherever and after whatever it is played."""

import subprocess
import sys

import pytest

from tests.support.doom import play, search_path
from tests.support.processes import DEADLINE

pytestmark = pytest.mark.needs_doom
PROGRAM = "from tests.support.doom import play; print(play(range(100)), play((5, 1)))"
DIGESTS = {  # of seeds, with vizdoom 1.3.2
    1: "d33d9ca85ad5bc8bbfffb4aa9f652b45f7abcdf4a2fd8a25e51b218670476fec",
    2: "6851339951c322da322e6289673f2f30da882d9e4912a840af27d6e47c13e783",
    3: "43e0b45544e746f202f458574b31ffb293e6176a076ccc77bf3a1f8f0353ac9e",
}


@pytest.mark.parametrize("seed", DIGESTS)
def test_the_pictures_and_rewards_of_a_seed_are_the_known_ones(seed):
    assert play((seed,)) == DIGESTS[seed]


@pytest.mark.slow
def test_random_play_of_a_hundred_seeds_is_equal_in_two_processes():
    programs = [
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True, env={"PYTHONPATH": search_path()}
        )
        for _ in range(2)
    ]
    found = [program.communicate(timeout=DEADLINE)[0].split() for program in programs]
    assert found[0] == found[1]
    assert found[0][1] == play((5, 1))  # after others, or first
