"""What is expected of a host that was measured with other numbers of jobs."""

import math

import pytest

from dreamfleet.coordinator.dispatch.host_stats import HostStats


def measured(**seconds):
    """The record of a host that returned `jobsN` jobs in so many seconds."""
    found = HostStats()
    for name, each in seconds.items():
        found.record_turnaround(int(name.removeprefix("jobs")), each, 0.0)
    return found


def test_between_two_measured_numbers_time_grows_by_equal_factors():
    host = measured(jobs1=1.0, jobs64=4.0)
    assert [host.expected_seconds(jobs) for jobs in (1, 8, 64)] == pytest.approx([1.0, 2.0, 4.0])


@pytest.mark.parametrize("host", [measured(jobs1=1.0, jobs4=100.0), measured(jobs1=0.001, jobs64=1.0)])
def test_between_two_numbers_one_slot_alone_would_not_need_more(host):
    times = [host.expected_seconds(2**size) for size in range(7)]
    assert times == sorted(times)
    assert times[1] <= 2 * times[0]


def test_beyond_what_was_measured():
    assert HostStats().expected_seconds(1) == math.inf
    host = measured(jobs8=2.0)
    assert 1.0 < host.expected_seconds(1) < 2.0 < host.expected_seconds(16) < 4.0
