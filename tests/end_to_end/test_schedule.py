"""A run of several stages with real workers: each is scored by its own settings, in a subspace, in dreams or driven.

Tests common/runs/stages.py, coordinator/run/generations.py, coordinator/settings/fork.py,
coordinator/settings/stage_tables.py and coordinator/optimisers/evolution.py.
"""

import json

import numpy as np
import pytest

from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.runs.run_folder import open_run
from tests.support import tasks
from tests.support.processes import call_here, printed, refused
from tests.support.same_bits import outcome

GENERATIONS, BEGUN = 8, [0, 4, 6]
STAGES = """
[[stage]]
score = -1000.0     # of any mean: that of generation 1 counts from generation 4 on
horizon = 4
patience = 3

[[stage]]
generations = 2
horizon = 7
patience = 0
population = 7
sigma0 = 0.3

[[stage]]
horizon = 10
episodes = 4
racing = true
"""


@pytest.fixture
def coordinator(processes, small):
    path = processes.folder / "stages.toml"
    path.write_text(STAGES)

    return processes.coordinator(
        *small, "--task", tasks.TOY, "--population", 5, "--episodes", 2, "--evaluate-every", 2,
        "--evaluation-episodes", 3, "--generations", GENERATIONS, "--schedule", path, name="night",
    )  # fmt: skip


@pytest.mark.slow
def test_a_run_of_three_stages_that_is_killed_in_one_scores_replays_and_shows_each(processes, coordinator):
    processes.worker("--task", tasks.TOY, "--run", "night")
    coordinator.wait_for_event("next stage")
    coordinator.end()
    assert processes.resume("night").finish()[0] == 0
    steps = [[steps for _, _, steps in episodes] for episodes in outcome(processes, "night").episodes]
    assert steps[0] == [3, 3], "patience cuts what never is rewarded"
    assert {each for candidate in steps[4 * 5 : 4 * 5 + 2 * 7] for each in candidate} == {7}
    assert sorted(map(len, steps[-7:])) == [2] * 3 + [4] * 4
    for generation in (3, 4, 6):
        words = ("verify", "candidate", "night", "--runs-dir", processes.runs, "--candidate", f"{generation}/1")
        assert "DIFFERS" not in printed(*words)
    _, out, err = call_here("runs", "show", "night", "--runs-dir", processes.runs, "--json")
    assert [each["since"] for each in json.loads(out)["stages"]] == BEGUN, err


def test_a_schedule_is_frozen_with_its_run_and_another_file_is_refused(processes, coordinator):
    coordinator.end()
    schedule = processes.folder / "stages.toml"
    again = ("coordinator", "--resume", "night", "--runs-dir", processes.runs)
    refused("--schedule", *again, "--schedule", schedule)
    other = processes.folder / "other.toml"
    for text, warned in ((STAGES, False), (STAGES.replace("generations = 2", "generations = 3"), True)):
        other.write_text(text)
        resumed = processes.resume("night", "--config", other)
        resumed.wait_for_event("begin")
        resumed.end()
        assert bool(resumed.events("kept", setting="schedule")) == warned


LEAVES_SUBSPACE = """
[[stage]]
generations = 3

[[stage]]
all_parameters = true
sigma0 = 0.05
"""


@pytest.mark.slow
def test_a_run_has_all_of_its_subspace_and_a_fork_goes_on_in_it_or_leaves_it(processes, small, random_bundle):
    shape, folder = random_bundle.controller_shape, processes.folder
    weights = np.random.default_rng(1).normal(size=(3, shape.features)).astype(np.float32)
    subspace = Subspace(weights, np.ones(3, np.float32), ("a", "b", "c"), random_bundle.sha256)
    subspace.save(folder / "few.npz", {})
    (folder / "stages.toml").write_text(LEAVES_SUBSPACE)
    searched = ("--subspace", folder / "few.npz", "--schedule", folder / "stages.toml")
    coordinator = processes.coordinator(
        *small, "--task", tasks.TOY, "--population", 5, "--generations", 7, "--evaluate-every", 2,
        "--evaluation-episodes", 2, *searched,
    )  # fmt: skip
    for name in ("few.npz", "stages.toml"):
        (folder / name).unlink()
    processes.worker("--task", tasks.TOY)
    coordinator.wait_for_event("generation", number=1)
    coordinator.end()
    file = folder / "fleet.toml"
    file.write_text('[run]\nsubspace = "none"\n')
    for flags in (("--subspace", "none"), ("--config", file)):
        refused("--sigma0", "coordinator", "--from", "test", "--runs-dir", processes.runs, *flags)
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


POPULATION, EPISODES = 4, 3


MIXES = """
[[stage]]
generations = 2

[[stage]]
driven = 0.5
generations = 1
episodes = 4
horizon = 60
sigma0 = 0.2

[[stage]]
driven = 1.0
episodes = 2
"""
DRIVEN = [0, 0, 2, 2, 2]  # of each candidate's episodes, by generation


@pytest.mark.slow
def test_a_run_that_dreams_then_mixes_then_drives_has_replayable_bits_through_kills(processes, random_bundle):
    path = processes.folder / "stages.toml"
    path.write_text(MIXES)
    coordinator = processes.coordinator(
        "--preset", "dream", "--bundle", random_bundle.path, "--population", POPULATION, "--episodes", EPISODES,
        "--horizon", 100, "--generations", len(DRIVEN), "--evaluate-every", 2, "--evaluation-episodes", 2,
        "--confirm-episodes", 2, "--schedule", path, name="night",
    )  # fmt: skip
    for number in range(2):
        processes.worker("--run", "night", "--name", f"w{number}")
    for generation in (1, 2, 3):
        coordinator.wait_for_event("generation", number=generation)
        coordinator.end()
        coordinator = processes.resume("night")
    assert coordinator.finish()[0] == 0
    with open_run(processes.runs, "night") as run:
        efforts = [each for each in run.efforts() if not each.confirming]
        assert sum(each.effort.driven + each.effort.dreamt for each in efforts) == sum(
            each.steps for each in run.history()
        )
        for generation, driven in enumerate(DRIVEN):
            results = [each for i in range(POPULATION) for each in run.results(generation, i)]
            wanted = sum(each.steps for each in results if each.episode < driven)
            assert sum(each.effort.driven for each in run.efforts() if each.generation == generation) == wanted
    for generation in range(len(DRIVEN)):
        candidate = ("--candidate", f"{generation}/3")
        assert "DIFFERS" not in printed("verify", "candidate", "night", "--runs-dir", processes.runs, *candidate)
    printed("evaluate", "--controller", "night", "--runs-dir", processes.runs, "--episodes", 1)
