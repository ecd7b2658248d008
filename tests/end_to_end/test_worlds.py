"""Evolving in the dream of a world that only the bundle describes."""

import numpy as np
import pytest

from dreamfleet.common.runs.run_folder import open_run
from tests.support.dreams import write_bundle_of
from tests.support.pixel_world import DODGE_TASK

GENERATIONS, POPULATION, EPISODES = 3, 6, 2


def evolve(processes, bundle, name, workers, *flags):
    """A run in the bundle's dream, whose means are judged in its world; its fitness, vectors and evaluations."""
    coordinator = processes.coordinator(
        "--preset", "pixels", "--bundle", bundle.path, "--population", POPULATION, "--episodes", EPISODES,
        "--horizon", 60, "--generations", GENERATIONS, "--evaluate-every", 1, "--evaluation-episodes", 2,
        "--confirm-episodes", 2, *flags, name=name,
    )  # fmt: skip
    crew = [
        processes.worker("--run", name, "--name", f"w{number}", "--task", DODGE_TASK) for number in range(workers)
    ]  # fmt: skip
    code, _ = coordinator.finish()
    assert code == 0, "".join(coordinator.lines + crew[0].lines)
    for each in crew:
        each.end()
    with open_run(processes.runs, name) as run:
        fitness = [[run.fitness(g, i) for i in range(POPULATION)] for g in range(GENERATIONS)]
        vectors = [run.candidate(g, i).tobytes() for g in range(GENERATIONS) for i in range(POPULATION)]
        found = [(each.generation, each.mean) for each in run.evaluations()]
        return fitness, vectors, found, np.load(run.controller_path)["parameters"].tobytes(), run.settings


@pytest.mark.slow
def test_a_bundles_world_gives_the_same_bits_on_one_worker_and_on_two(processes, tmp_path):
    bundle = write_bundle_of("choices", tmp_path / "b.zip")
    alone = evolve(processes, bundle, "alone", 1, "--variant", "decide_every=2")
    assert alone == evolve(processes, bundle, "two", 2, "--variant", "decide_every=2")
    settings = alone[-1]
    assert (settings.task.task, settings.controller.actions) == ("dream", 3)
    assert any(fitness for each in alone[0] for fitness in each), "somebody lived"
    runs = ("--runs-dir", processes.runs)
    code, out, err = processes.call("replay", "alone", *runs, "--candidate", "1/2", "--trust", DODGE_TASK.split(":")[0])
    assert (code, out.count("same bits")) == (0, EPISODES), err


@pytest.mark.slow
def test_an_end_of_the_runs_own_changes_its_dreams_and_its_controller_is_of_the_world(processes, tmp_path):
    bundle = write_bundle_of("choices", tmp_path / "b.zip")
    plain, own = (evolve(processes, bundle, name, 1, *flags) for name, flags in
                  (("plain", ()), ("own", ("--end", "0.999"))))  # fmt: skip
    assert own[0] != plain[0]
    assert (own[-1].task.end, own[-1].task.version) == ("0.999", 11)
    code, _, err = processes.call(
        "evaluate", "--controller", "own", "--runs-dir", processes.runs, "--episodes", 1, "--trust",
        DODGE_TASK.split(":")[0],
    )  # fmt: skip
    assert code == 0, err
