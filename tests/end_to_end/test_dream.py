"""Evolving in the dream, with means that are driven in reality."""

import pytest

from dreamfleet.common.runs.run_folder import open_run
from tests.support.processes import call_here
from tests.support.same_bits import evolve

POPULATION, EPISODES = 4, 3


@pytest.fixture
def dreamt(random_bundle):
    return (
        "--preset", "dream", "--bundle", random_bundle.path, "--population", POPULATION, "--episodes", EPISODES,
        "--horizon", 100, "--generations", 4, "--evaluate-every", 2, "--evaluation-episodes", 2, "--confirm-episodes",
        2,
    )  # fmt: skip


@pytest.mark.long
def test_who_dreams_on_a_torch_device_changes_no_bit_either(processes, dreamt, monkeypatch):
    evolve(processes, "plain", 1, *dreamt, "--generations", 1)
    monkeypatch.setenv("DREAMFLEET_WORKER_TORCH_DEVICE", "cpu")
    assert evolve(processes, "one", 1, *dreamt) == evolve(processes, "two", 2, *dreamt)
    classes = []
    for name in ("plain", "one", "two"):
        with open_run(processes.runs, name) as run:
            classes.append({each.host_class for each in run.classes.largest})
            named = [name for each in run.classes.largest for name in each.fingerprints]
            assert all(("dreams-on-cpu" in each) == (name != "plain") for each in named)
    assert classes[1] == classes[2]
    assert not classes[0] & classes[1]
    code, out, err = call_here("verify", "candidate", "two", "--runs-dir", processes.runs, "--candidate", "2/3")
    assert (code, out.count("same bits")) == (0, EPISODES), err


STAGES = """
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
def test_a_run_that_dreams_then_mixes_then_drives_has_replayable_bits_through_kills(processes, dreamt):
    path = processes.folder / "stages.toml"
    path.write_text(STAGES)
    coordinator = processes.coordinator(*dreamt, "--schedule", path, "--generations", len(DRIVEN), name="night")
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
        code, out, err = call_here("verify", "candidate", "night", "--runs-dir", processes.runs, *candidate)
        assert (code, "DIFFERS" in out) == (0, False), err
    code, out, err = call_here("evaluate", "--controller", "night", "--runs-dir", processes.runs, "--episodes", 1)
    assert code == 0, err
