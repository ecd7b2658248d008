"""A disk that fills up in the middle of a run."""

import os
import subprocess

import pytest

from common.runs import open_run
from tests.support import tasks

pytestmark = [
    pytest.mark.timeout(240),
    pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a small disk"),
]


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 19 MB, of which the world model's copy takes 14."""
    place = tmp_path / "disk"
    place.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=19m", "tmpfs", place], check=False).returncode:
        pytest.skip("this host does not let us mount")
    yield place
    subprocess.run(["umount", "--lazy", place], check=True)


def test_a_full_disk_is_a_clear_error_and_with_more_room_the_run_goes_on(processes, random_bundle, small_disk):
    flags = ("--task", tasks.TOY, "--population", 64, "--episodes", 1, "--evaluate-every", 0, "--generations", 40)
    processes.runs = small_disk
    full = processes.coordinator("--bundle", random_bundle.path, *flags, name="small")
    processes.worker("--task", tasks.TOY)
    code, _ = full.finish(120)
    assert code not in (0, 130)
    assert "full" in full.lines[-1]
    with open_run(small_disk, "small") as run:
        before = [(each.number, each.mean) for each in run.history()]
    assert before
    subprocess.run(["mount", "-o", "remount,size=200m", small_disk], check=True)
    again = processes.start(
        "coordinator", "--resume", "small", "--runs-dir", small_disk, "--listen", processes.endpoint,
        "--beat", "0.2", "--generations", 40,
    )  # fmt: skip
    assert again.finish(120)[0] == 0

    processes.runs = small_disk.parent / "roomy"
    whole = processes.coordinator("--bundle", random_bundle.path, *flags, name="whole")
    processes.worker("--task", tasks.TOY, "--run", "whole")
    assert whole.finish(120)[0] == 0
    with open_run(small_disk, "small") as one, open_run(processes.runs, "whole") as other:
        history = [(each.number, each.mean) for each in one.history()]
        assert history[: len(before)] == before
        assert history == [(each.number, each.mean) for each in other.history()]
