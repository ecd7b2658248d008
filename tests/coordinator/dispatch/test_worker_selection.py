"""The choice of a worker asks few of them, and chooses as if it asked all; what is expected of a host by its record.
Tests host_stats.py."""

import math
import random

import pytest

from dreamfleet.coordinator.dispatch.host_stats import HostStats
from dreamfleet.coordinator.dispatch.member import Lease, Member
from dreamfleet.coordinator.dispatch.worker_selection import WorkerSelection


def crowd(source):
    """Members with records, leases, losses and ages of all kinds."""
    members = {}
    for number in range(source.randrange(1, 12)):
        stats = HostStats()
        for _ in range(source.randrange(4)):
            stats.record_turnaround(source.randrange(1, 40), source.choice([0.1, 1.0, 1.2, 9.0]), 100.0)
        for _ in range(source.choice([0, 0, 3])):
            stats.record_loss(source.choice([5.0, 500.0]))
        capacity = source.choice([1, 4, 16])
        member = Member(f"w{number}", capacity, "f", 1, 100.0, source.choice([0.0, 90.0]), stats, capacity)
        member.is_unconfirmed, member.is_held = False, source.random() < 0.1
        for each in range(source.randrange(2 * capacity + 1)):
            lease = Lease(0, member.start_group(100.0), source.random() < 0.1)
            member.add_lease(bytes([number, each]), lease)
        members[member.identity] = member
    return members


def test_it_picks_the_least_loaded_of_those_that_return_a_job_in_time():
    picked = 0
    for seed in range(300):
        source = random.Random(seed)
        members = crowd(source)
        shares = {name: member.held_share for name, member in members.items() if member.credit > 0}
        room = {name: members[name].credit for name in shares}
        waiting = source.randrange(1, 200)
        selection = WorkerSelection(members, shares, waiting, 100.0)
        for _ in range(waiting):
            in_time = [name for name in shares if selection._finishes_in_time(name)]
            best = min(in_time, key=selection._rank, default=selection._soonest(shares))
            name = selection.pick(shares)
            assert name == best
            if name is None:
                break
            picked += 1
            selection.assign(name)
            shares[name] += 1
            room[name] -= 1
            if not room[name]:
                del shares[name]
    assert picked > 3000


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


def test_one_long_episode_hardly_changes_what_a_job_takes_and_a_slower_host_soon_does():
    host = HostStats()
    for seconds in [0.5, 1.5] * 50:
        host.record_duration("evaluate", seconds)
    assert host.evaluation.mean == pytest.approx(1.0, rel=0.05)
    host.record_duration("evaluate", 10.0)
    assert host.evaluation.mean < 1.2
    for _ in range(200):
        host.record_duration("evaluate", 3.0)
    assert host.evaluation.mean == pytest.approx(3.0, rel=0.1)


def test_beyond_what_was_measured():
    assert HostStats().expected_seconds(1) == math.inf
    host = measured(jobs8=2.0)
    assert 1.0 < host.expected_seconds(1) < 2.0 < host.expected_seconds(16) < 4.0
