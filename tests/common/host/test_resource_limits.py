import os

import pytest

from dreamfleet.common.host.resource_limits import usable_cores, usable_memory

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinity on this system")


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


NESTED = "0::/user.slice/job-7/step"
OLD = "7:memory:/docker/1\n4:cpu,cpuacct:/docker/1\n1:name=systemd:/x"
QUOTAS = {
    "max 100000": 64, "200000 100000": 2, "150000 100000": 2, "10000 100000": 1, "9900000 100000": 64, "rubbish": 64,
    "5 0": 64,
}  # fmt: skip


@pytest.mark.parametrize(
    ("group", "files", "found"),
    [
        *(("0::/", {"cpu.max": quota}, cores) for quota, cores in QUOTAS.items()),  # rounded up
        (NESTED, {"user.slice/job-7/step/cpu.max": "max 100000", "user.slice/job-7/cpu.max": "300000 100000",
                  "user.slice/cpu.max": "800000 100000"}, 3),
        (OLD, {"cpu/docker/1/cpu.cfs_quota_us": "400000", "cpu/docker/1/cpu.cfs_period_us": "100000",
               "cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, 4),
    ],
)  # fmt: skip
def test_the_smallest_quota_of_all_parents_counts(monkeypatch, host, group, files, found):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)))
    groups, own, write = host
    own.write_text(f"{group}\n")
    for name, text in files.items():
        write(name, text)
    assert usable_cores(groups, own) == found
    assert usable_cores(groups / "none", groups / "nothing") == 64


def test_a_system_without_affinity_has_the_cores_of_its_host(monkeypatch, tmp_path):
    assert 1 <= usable_cores() <= len(os.sched_getaffinity(0))
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 10)
    assert usable_cores(tmp_path, tmp_path / "nothing") == 10


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
