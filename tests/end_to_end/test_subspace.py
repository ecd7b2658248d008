"""A run that searches in a subspace, and leaves it: through kills, and in forks that stay in it or do not."""

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.subspace import SearchSpace, Subspace
from dreamfleet.common.runs.run_folder import open_run
from tests.support import tasks
from tests.support.processes import call_here

STAGES = """
[[stage]]
generations = 3

[[stage]]
all_parameters = true
sigma0 = 0.05
"""


@pytest.mark.slow
def test_a_run_keeps_to_its_subspace_through_kills_until_its_schedule_leaves_it(processes, small, random_bundle):
    shape, folder = random_bundle.controller_shape, processes.folder
    weights = np.random.default_rng(1).normal(size=(3, shape.features)).astype(np.float32)
    subspace = Subspace(weights, np.ones(3, np.float32), ("a", "b", "c"), random_bundle.sha256)
    subspace.save(folder / "few.npz", {})
    (folder / "stages.toml").write_text(STAGES)
    start = np.linspace(-1, 1, shape.size, dtype=np.float32)
    Controller(shape, start, tasks.TOY, random_bundle.sha256).save(folder / "start.npz")
    searched = ("--subspace", folder / "few.npz", "--schedule", folder / "stages.toml")
    coordinator = processes.coordinator(
        *small, "--task", tasks.TOY, "--population", 5, "--generations", 7, "--evaluate-every", 2,
        "--evaluation-episodes", 2, "--init", folder / "start.npz", *searched,
    )  # fmt: skip
    for name in ("few.npz", "start.npz", "stages.toml"):
        (folder / name).unlink()  # a run has all that it needs
    worker = processes.worker("--task", tasks.TOY)
    coordinator.wait_for_event("generation", number=1)
    coordinator.end()
    check_forks(processes, subspace)
    for generation in (3, 5):
        coordinator = processes.resume()
        coordinator.wait_for_event("generation", number=generation)
        coordinator.end()
    worker.end()
    with open_run(processes.runs, "test") as run:
        asked = np.array([[run.candidate(g, i) for i in range(5)] for g in range(5)]).astype(np.float64)
    dimension = SearchSpace(subspace, shape).dimension
    assert np.linalg.matrix_rank((asked[:3] - start).reshape(15, -1), tol=1e-4) <= dimension < shape.size
    assert np.linalg.matrix_rank((asked - start).reshape(25, -1), tol=1e-4) > dimension


def check_forks(processes, subspace):
    """A fork goes on in the subspace, or leaves it with a step of its own."""
    file = processes.folder / "fleet.toml"
    file.write_text('[run]\nsubspace = "none"\n')
    for flags in (("--subspace", "none"), ("--config", file)):
        code, _, err = call_here("coordinator", "--from", "test", "--runs-dir", processes.runs, *flags)
        assert (code, "--sigma0" in err) == (2, True), err
    for name, flags in (("same", ()), ("free", ("--subspace", "none", "--sigma0", 0.1))):
        forked = processes.fork("test", "--run", name, *flags)
        forked.wait_for_event("begin")
        forked.end()
    with open_run(processes.runs, "same") as same, open_run(processes.runs, "free") as free:
        assert (same.settings.subspace, free.settings.subspace) == (subspace.sha256, "")
        assert [each.all_parameters for each in same.settings.stages] == [False, True]
        assert not any(each.all_parameters for each in free.settings.stages)
    file.write_text('[run]\nsubspace = "gone.npz"\n')
    again = processes.resume("same", "--config", file)
    again.wait_for_event("kept", setting="subspace")
    again.end()
