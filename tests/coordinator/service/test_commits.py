"""When the coordinator commits. Tests service.py."""

import pytest

from dreamfleet.coordinator.service.service import next_commit


@pytest.mark.parametrize(("took", "waits"), [(0.0, 0.005), (0.001, 0.005), (0.05, 0.05), (0.3, 0.2), (3600.0, 0.2)])
def test_a_commit_waits_as_long_as_the_last_one_took_and_never_long(took, waits):
    assert next_commit(100.0, 100.0 + took) == pytest.approx(100.0 + took + waits)
