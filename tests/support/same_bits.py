"""A short run in the dream, and what it computed."""

import numpy as np

from dreamfleet.common.runs.run_folder import open_run

GENERATIONS, POPULATION, EPISODES = 4, 6, 2

SETTINGS = (
    "--bundle", "tiny", "--population", POPULATION, "--episodes", EPISODES, "--horizon", 30,
    "--generations", GENERATIONS, "--seed", 5,
)  # fmt: skip


def outcome(processes, name):
    """Every fitness of every candidate, and the reported mean, after the run."""
    with open_run(processes.runs, name) as run:
        fitness = [[run.fitness(g, i) for i in range(POPULATION)] for g in range(GENERATIONS)]
        episodes = [
            [(each.seed, each.fitness, each.steps) for each in run.results(g, i)]
            for g in range(GENERATIONS) for i in range(POPULATION)
        ]  # fmt: skip
        vectors = [run.candidate(g, i).tobytes() for g in range(GENERATIONS) for i in range(POPULATION)]
        return fitness, episodes, vectors, np.load(run.controller_path)["parameters"].tobytes()
