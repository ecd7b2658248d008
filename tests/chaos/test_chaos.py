"""A short one; `make chaos` is the long one."""

import pytest

from tests.chaos.chaos import compare


@pytest.mark.timeout(300)
def test_a_fleet_under_faults_gives_the_undisturbed_fleets_bits(tmp_path):
    figures = compare(tmp_path, faults=8, seed=3)
    assert figures["identical"]
    assert figures["lost"] == 0
