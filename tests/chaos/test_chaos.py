"""Short ones; `make chaos` is the long one.

Tests coordinator/dispatch/fleet.py, coordinator/run/run.py, coordinator/storage/journal.py,
worker/service/run_session.py and worker/service/slot.py.
"""

import pytest

from tests.chaos.chaos import NARROW, WIDE, compare


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("stage", [NARROW, pytest.param(WIDE, marks=pytest.mark.long)], ids=["narrow", "wide"])
def test_a_fleet_under_faults_gives_the_undisturbed_fleets_bits(tmp_path, stage):
    figures = compare(tmp_path, faults=8, seed=3, stage=stage)
    assert figures["identical"]
    assert figures["lost"] == 0
