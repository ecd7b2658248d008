"""Cores that a process may use, as a host, a container and a batch system tell them."""

import os

import pytest

from dreamfleet.common.host.resource_limits import usable_cores

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinity on this system")


@pytest.fixture
def many(monkeypatch):
    """A host of 64 cores."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)))


@pytest.fixture
def host(tmp_path):
    """Control groups, and which are ours; a function that writes a file of them."""
    own = tmp_path / "own"
    own.write_text("0::/\n")

    def write(name, text):
        path = tmp_path / "groups" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    return tmp_path / "groups", own, write


def test_without_control_groups_the_scheduler_says_it(many, tmp_path):
    assert usable_cores(tmp_path / "none", tmp_path / "nothing") == 64


@pytest.mark.parametrize(
    ("told", "found"),
    [
        ("max 100000", 64), ("200000 100000", 2), ("150000 100000", 2), ("10000 100000", 1),
        ("9900000 100000", 64), ("rubbish", 64), ("5 0", 64),
    ],
)  # fmt: skip
def test_a_container_has_the_time_that_its_group_is_given(many, host, told, found):
    groups, own, write = host
    write("cpu.max", told)
    assert usable_cores(groups, own) == found


def test_the_smallest_quota_on_the_way_up_holds(many, host):
    groups, own, write = host
    own.write_text("0::/user.slice/job-7/step\n")
    write("user.slice/job-7/step/cpu.max", "max 100000")
    write("user.slice/job-7/cpu.max", "300000 100000")
    write("user.slice/cpu.max", "800000 100000")
    assert usable_cores(groups, own) == 3


def test_groups_of_version_1(many, host):
    groups, own, write = host
    own.write_text("7:memory:/docker/1\n4:cpu,cpuacct:/docker/1\n1:name=systemd:/x\n")
    write("cpu/docker/1/cpu.cfs_quota_us", "400000")
    write("cpu/docker/1/cpu.cfs_period_us", "100000")
    write("cpu/cpu.cfs_quota_us", "-1")
    write("cpu/cpu.cfs_period_us", "100000")
    assert usable_cores(groups, own) == 4


def test_a_system_that_knows_no_affinity(monkeypatch, tmp_path):
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 10)
    assert usable_cores(tmp_path, tmp_path / "nothing") == 10


def test_here_it_is_as_many_as_the_scheduler_lets_us_have_or_fewer():
    assert 1 <= usable_cores() <= len(os.sched_getaffinity(0))
