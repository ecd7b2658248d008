"""The core is whole without its add-ons: a tree that lacks their folders evolves and judges a controller."""

import shutil

import pytest

from dreamfleet.common.runs.run_folder import open_run
from tests.support.processes import ROOT

LEFT_OUT = shutil.ignore_patterns("addons", "__pycache__")


@pytest.mark.slow
def test_a_run_needs_no_add_on(tmp_path, processes):
    """The entry points stay, as they are metadata of the installation: one whose module is gone counts as absent."""
    tree = tmp_path / "tree"
    shutil.copytree(ROOT / "dreamfleet", tree / "dreamfleet", ignore=LEFT_OUT)
    small = ("--generations", 2, "--population", 4, "--episodes", 1, "--confirm-episodes", 2)
    coordinator = processes.coordinator("--task", "gym:CartPole-v1", *small, root=tree)
    worker = processes.worker("--exit-when-done", root=tree)
    gone = processes.start("inspect", "--help", root=tree)
    assert [each.finish()[0] for each in (coordinator, worker)] == [0, 0]
    assert gone.finish()[0] == 1  # so it is that tree which runs
    with open_run(processes.runs, "test") as run:
        assert len(run.history()) == 2
        assert run.confirmation().episodes == 2
