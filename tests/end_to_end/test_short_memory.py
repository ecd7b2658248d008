"""A control group of too little memory: the kernel kills what scores in it."""

import os
from pathlib import Path

import pytest

from tests.support import rough_tasks

GROUPS = Path("/sys/fs/cgroup/memory")  # version 1


@pytest.fixture
def limited():
    """The words that start a program in a control group of so many MiB, with its children."""
    made = []

    def words(mib):
        group = GROUPS / f"dreamfleet-test-{os.getpid()}-{len(made)}"
        try:
            group.mkdir()
            made.append(group)
            (group / "memory.limit_in_bytes").write_text(str(mib << 20))
        except OSError as error:
            pytest.skip(f"no control groups: {error}")
        return ("sh", "-c", f'echo $$ > {group}/cgroup.procs; exec "$@"', "-")

    yield words
    for each in made:
        for pid in (each / "cgroup.procs").read_text().split():
            (GROUPS / "cgroup.procs").write_text(pid)
        each.rmdir()


@pytest.mark.slow
def test_a_slot_that_the_kernel_kills_blames_its_host(processes, random_bundle, limited):
    name = rough_tasks.name_of(rough_tasks.Hungry)
    coordinator = processes.coordinator("--bundle", random_bundle.path, "--task", name, "--population", 4)
    worker = processes.worker("--task", name, "--drain-timeout", 1, inside=limited(500))
    assert "SIGKILL" in coordinator.wait_for_event("paused")["message"]
    processes.call("stop", "test", "--workers", "--connect", processes.endpoint)
    assert worker.finish()[0] == 0
    assert not any("Traceback" in line for line in worker.lines)
