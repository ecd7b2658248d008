"""Evolving in the dream, with means that are driven in reality."""

import json
import os
import signal

import pytest

from dreamfleet.common.runs.run_folder import open_run
from tests.support.bundles import states, write_random_bundle
from tests.support.processes import call_here
from tests.support.same_bits import outcome

GENERATIONS, POPULATION, EPISODES = 4, 4, 3


def begin(processes, bundle, name, *flags):
    return processes.coordinator(
        "--preset", "dream", "--bundle", bundle.path, "--population", POPULATION, "--episodes", EPISODES,
        "--horizon", 100, "--generations", GENERATIONS, "--evaluate-every", 2, "--evaluation-episodes", 2,
        "--confirm-episodes", 2, *flags, name=name,
    )  # fmt: skip


@pytest.mark.slow
def test_who_dreams_and_who_dies_meanwhile_changes_no_bit(processes, random_bundle):
    coordinator = begin(processes, random_bundle, "alone")
    worker = processes.worker("--run", "alone")
    assert coordinator.finish()[0] == 0
    worker.end()
    coordinator = begin(processes, random_bundle, "three")
    workers = [processes.worker("--run", "three", "--name", f"w{number}") for number in range(3)]
    coordinator.wait_for_event("generation", number=0)
    os.kill(workers[1].popen.pid, signal.SIGKILL)
    assert coordinator.finish()[0] == 0
    alone = outcome(processes, "alone")
    assert alone == outcome(processes, "three")
    assert [each.generation for each in alone.evaluations] == [1, 3]
    code, out, err = call_here("verify", "candidate", "alone", "--runs-dir", processes.runs, "--candidate", "2/3")
    assert code == 0, err
    assert out.count("same bits") == EPISODES
    code, out, err = call_here("evaluate", "--controller", "alone", "--runs-dir", processes.runs, "--episodes", 1)
    assert code == 0, err


@pytest.mark.long
def test_who_dreams_on_a_torch_device_changes_no_bit_either(processes, random_bundle, monkeypatch):
    coordinator = begin(processes, random_bundle, "plain", "--generations", 1)
    worker = processes.worker("--run", "plain")
    assert coordinator.finish()[0] == 0
    worker.end()
    monkeypatch.setenv("DREAMFLEET_WORKER_TORCH_DEVICE", "cpu")
    for name, workers in (("one", 1), ("two", 2)):
        coordinator = begin(processes, random_bundle, name)
        crew = [processes.worker("--run", name, "--name", f"w{number}") for number in range(workers)]
        coordinator.wait_for_event("generation", number=0)
        if workers > 1:
            os.kill(crew.pop().popen.pid, signal.SIGKILL)
        assert coordinator.finish()[0] == 0, "".join(coordinator.lines)
        for each in crew:
            each.end()
    assert outcome(processes, "one") == outcome(processes, "two")
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


@pytest.mark.slow
def test_dreams_from_recorded_states_are_replayed_and_judged(processes, tmp_path):
    bundle = write_random_bundle(tmp_path / "b.zip", recorded=states(20))
    coordinator = begin(processes, bundle, "alone", "--recorded", 0.5)
    processes.worker("--run", "alone")
    assert coordinator.finish()[0] == 0, "".join(coordinator.lines)
    runs = ("--runs-dir", processes.runs)
    code, out, err = call_here("verify", "candidate", "alone", *runs, "--candidate", "2/3")
    assert (code, out.count("same bits")) == (0, EPISODES), err
    code, out, err = call_here("runs", "show", "alone", *runs, "--json")
    assert json.loads(out)["settings"]["task"]["recorded"] == 0.5, err
    code, out, err = call_here("evaluate", "--controller", "alone", *runs, "--episodes", 1)
    assert code == 0, err
    code, out, err = call_here("coordinator", "--from", "alone", *runs, "--task", "car-racing")
    assert (code, err.count("\n")) == (2, 1)
    assert "--recorded" in err


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


def staged(processes, bundle, name, *flags):
    path = processes.folder / "stages.toml"
    path.write_text(STAGES)
    return begin(processes, bundle, name, "--schedule", path, "--generations", len(DRIVEN), *flags)


@pytest.mark.slow
def test_a_run_that_dreams_then_mixes_then_drives_gives_the_same_bits_through_kills(processes, random_bundle):
    coordinator = staged(processes, random_bundle, "calm")
    coordinator.wait_for_event("stage")
    worker = processes.worker("--run", "calm", "--slots", 2)
    coordinator.wait_for_event("next stage", times=2)
    assert coordinator.finish()[0] == 0
    worker.end()
    coordinator = staged(processes, random_bundle, "night")
    for number in range(2):
        processes.worker("--run", "night", "--name", f"w{number}")
    for generation in (1, 2, 3):
        coordinator.wait_for_event("generation", number=generation)
        coordinator.end()
        coordinator = processes.resume("night")
    assert coordinator.finish()[0] == 0
    scores = []
    for name in ("calm", "night"):
        with open_run(processes.runs, name) as run:
            places = [(g, i) for g in range(len(DRIVEN)) for i in range(POPULATION)]
            scores.append([(run.fitness(*place), [each.steps for each in run.results(*place)]) for place in places])
            efforts = [each.effort for each in run.efforts() if not each.confirming]
            assert sum(each.driven + each.dreamt for each in efforts) == sum(each.steps for each in run.history())
            for generation, driven in enumerate(DRIVEN):
                results = [each for i in range(POPULATION) for each in run.results(generation, i)]
                wanted = sum(each.steps for each in results if each.episode < driven)
                assert sum(each.effort.driven for each in run.efforts() if each.generation == generation) == wanted
    assert scores[0] == scores[1]
    for generation in range(1, len(DRIVEN)):
        candidate = ("--candidate", f"{generation}/3")
        code, out, err = call_here("verify", "candidate", "night", "--runs-dir", processes.runs, *candidate)
        assert (code, "DIFFERS" in out) == (0, False), err
    code, out, err = call_here("evaluate", "--controller", "night", "--runs-dir", processes.runs, "--episodes", 1)
    assert code == 0, err
