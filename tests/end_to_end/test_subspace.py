"""A run that searches in a subspace, and leaves it, with real processes: the same bits through kills, had again."""

import json

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.subspace import SearchSpace, Subspace
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_paths import CONTROLLER
from tests.support import tasks

STAGES = """
[[stage]]
generations = 3

[[stage]]
whole = true
sigma0 = 0.05
"""


@pytest.fixture
def subspace(random_bundle):
    features = random_bundle.controller_shape.features
    weights = np.random.default_rng(1).normal(size=(3, features)).astype(np.float32)
    return Subspace(weights, np.ones(3, np.float32), ("a", "b", "c"), random_bundle.sha256)


@pytest.fixture
def begin(processes, random_bundle, subspace):
    subspace.save(processes.folder / "few.npz", {})
    (processes.folder / "stages.toml").write_text(STAGES)
    shape = random_bundle.controller_shape
    start = np.linspace(-1, 1, shape.size, dtype=np.float32)
    Controller(shape, start, tasks.TOY, random_bundle.sha256).save(processes.folder / "start.npz")

    def coordinator(name):
        return processes.coordinator(
            "--bundle", random_bundle.path, "--task", tasks.TOY, "--population", 5, "--episodes", 2, "--generations", 6,
            "--evaluate-every", 2, "--evaluation-episodes", 2, "--subspace", processes.folder / "few.npz", "--schedule",
            processes.folder / "stages.toml", "--init", processes.folder / "start.npz", name=name,
        )  # fmt: skip

    return coordinator


def candidates(processes, name):
    with open_run(processes.runs, name) as run:
        return np.array([[run.candidate(g, i) for i in range(5)] for g in range(6)]).astype(np.float64)


@pytest.mark.slow
def test_the_same_bits_through_kills_and_again_by_the_receipt(processes, begin, subspace, random_bundle):
    coordinator = begin("calm")
    coordinator.wait_for_event("stage")
    worker = processes.worker("--task", tasks.TOY, "--run", "calm")
    assert coordinator.finish()[0] == 0
    worker.end()
    coordinator = begin("night")
    for name in ("few.npz", "start.npz", "stages.toml"):
        (processes.folder / name).unlink()  # a run has all that it needs
    processes.worker("--task", tasks.TOY, "--run", "night", "--exit-when-done")
    for generation in (1, 3):
        coordinator.wait_for_event("generation", number=generation)
        coordinator.end()
        coordinator = processes.resume("night")
    assert coordinator.finish()[0] == 0
    asked = candidates(processes, "night")
    assert (asked == candidates(processes, "calm")).all()
    shape = random_bundle.controller_shape
    away = asked - np.linspace(-1, 1, shape.size)
    dimension = SearchSpace(subspace, shape).dimension
    inside, outside = away[:3].reshape(15, -1), away[3:].reshape(15, -1)
    assert np.linalg.matrix_rank(inside, tol=1e-4) <= dimension < shape.size
    assert np.linalg.matrix_rank(np.concatenate([inside, outside]), tol=1e-4) > dimension

    kept = processes.folder / "kept.npz"
    (processes.runs / "night" / CONTROLLER).rename(kept)
    again = processes.start("verify", "run", kept, "--bundle", random_bundle.path, "--runs-dir", processes.runs,
                            "--listen", processes.endpoint, "--beat", 0.2, "--json")  # fmt: skip
    processes.worker("--task", tasks.TOY, "--run", "kept-again", "--exit-when-done")
    code, out = again.finish()
    assert (code, json.loads(out)["same"]) == (0, True)


@pytest.mark.slow
def test_a_fork_goes_on_in_it_or_leaves_it_with_a_step_of_its_own(processes, begin, subspace):
    coordinator = begin("night")
    processes.worker("--task", tasks.TOY, "--run", "night")
    coordinator.wait_for_event("generation", number=1)
    coordinator.end()
    fork = ("coordinator", "--from", "night", "--runs-dir", processes.runs, "--listen", processes.endpoint)
    code, _, err = processes.call(*fork, "--subspace", "none")
    assert (code, "--sigma0" in err) == (2, True), err
    (processes.folder / "fleet.toml").write_text('[run]\nsubspace = "none"\n')
    code, _, err = processes.call(*fork, "--config", processes.folder / "fleet.toml")
    assert (code, "--sigma0" in err) == (2, True), err
    forked = processes.start(*fork, "--run", "same")
    forked.wait_for_event("begin")
    forked.end()
    forked = processes.start(*fork, "--run", "free", "--subspace", "none", "--sigma0", 0.1)
    forked.wait_for_event("begin", incarnation=1)
    forked.end()
    with open_run(processes.runs, "same") as same, open_run(processes.runs, "free") as free:
        assert (same.settings.subspace, free.settings.subspace) == (subspace.sha256, "")
        assert [each.whole for each in same.settings.stages] == [False, True]
        assert not any(each.whole for each in free.settings.stages)
    (processes.folder / "fleet.toml").write_text('[run]\nsubspace = "gone.npz"\n')
    again = processes.resume("night", "--config", processes.folder / "fleet.toml")
    again.wait_for_event("kept", setting="subspace")
    again.end()
