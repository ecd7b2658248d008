"""Usable cores by affinity masks and cgroup quotas, and usable memory."""

import os

import pytest

from dreamfleet.common.host.resource_limits import usable_cores, usable_memory

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinity on this system")


@pytest.fixture
def many(monkeypatch):
    """A host of 64 cores."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)))


@pytest.fixture
def host(tmp_path):
    """A cgroup file system and the list of this process's cgroups, with a function that writes a file in them."""
    own = tmp_path / "own"
    own.write_text("0::/\n")

    def write(name, text):
        path = tmp_path / "groups" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    return tmp_path / "groups", own, write


def test_without_cgroups_the_affinity_counts(many, tmp_path):
    assert usable_cores(tmp_path / "none", tmp_path / "nothing") == 64


@pytest.mark.parametrize(
    ("quota", "found"),
    [
        ("max 100000", 64), ("200000 100000", 2), ("150000 100000", 2), ("10000 100000", 1),
        ("9900000 100000", 64), ("rubbish", 64), ("5 0", 64),
    ],
)  # fmt: skip
def test_a_containers_quota_is_rounded_up(many, host, quota, found):
    groups, own, write = host
    write("cpu.max", quota)
    assert usable_cores(groups, own) == found


def test_the_smallest_quota_of_all_parents_counts(many, host):
    groups, own, write = host
    own.write_text("0::/user.slice/job-7/step\n")
    write("user.slice/job-7/step/cpu.max", "max 100000")
    write("user.slice/job-7/cpu.max", "300000 100000")
    write("user.slice/cpu.max", "800000 100000")
    assert usable_cores(groups, own) == 3


def test_cgroups_version_1(many, host):
    groups, own, write = host
    own.write_text("7:memory:/docker/1\n4:cpu,cpuacct:/docker/1\n1:name=systemd:/x\n")
    write("cpu/docker/1/cpu.cfs_quota_us", "400000")
    write("cpu/docker/1/cpu.cfs_period_us", "100000")
    write("cpu/cpu.cfs_quota_us", "-1")
    write("cpu/cpu.cfs_period_us", "100000")
    assert usable_cores(groups, own) == 4


def test_a_system_without_affinity(monkeypatch, tmp_path):
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 10)
    assert usable_cores(tmp_path, tmp_path / "nothing") == 10


def test_this_host_has_at_most_as_many_cores_as_the_affinity_mask():
    assert 1 <= usable_cores() <= len(os.sched_getaffinity(0))


def test_memory_is_that_of_the_host_and_its_swap_within_the_limits_of_all_cgroups(host, tmp_path):
    groups, own, write = host
    info = tmp_path / "meminfo"
    info.write_text("MemTotal:       8 kB\nMemFree:        1 kB\nSwapTotal:      2 kB\nHugePages_Total:       0\n")
    assert usable_memory(groups, own, info) == 10 * 1024
    write("memory.max", "max\n")
    assert usable_memory(groups, own, info) == 10 * 1024
    own.write_text("0::/a/b\n")
    write("a/memory.max", "5000\n")
    assert usable_memory(groups, own, info) == 5000
    own.write_text("4:memory:/c\n")
    write("memory/c/memory.limit_in_bytes", "4000\n")
    assert usable_memory(groups, own, info) == 4000
    assert usable_memory(tmp_path / "none", tmp_path / "nothing", tmp_path / "nothing") > 10 * 1024
