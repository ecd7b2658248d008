"""The outcome of a run, and a short run in the world of the car."""

from typing import NamedTuple

import numpy as np

from dreamfleet.common.runs.run_folder import open_run
from tests.support.processes import call_here, printed

GENERATIONS, POPULATION, EPISODES = 4, 6, 2

SETTINGS = (
    "--bundle", "tiny", "--population", POPULATION, "--episodes", EPISODES, "--horizon", 30,
    "--generations", GENERATIONS, "--seed", 5,
)  # fmt: skip


class Outcome(NamedTuple):
    """All that a run computed, but not who scored it nor when."""

    fitness: list
    vectors: list
    episodes: list
    history: list
    evaluations: list
    confirmation: object
    parameters: bytes


def outcome(processes, name):
    """What a run has come to, candidate by candidate; a generation that is open does not count.

    Nor do the episodes of a candidate that failed: how many of them were scored before that depends on the moment.
    """
    with open_run(processes.runs, name) as run:
        history = run.history()
        closed = {each.number for each in history}
        places = [(each.generation, each.number) for each in run.candidates() if each.generation in closed]
        fitness = [run.fitness(*place) for place in places]
        scored = [() if each is None else run.results(*place) for place, each in zip(places, fitness, strict=True)]
        return Outcome(
            fitness,
            [run.candidate(*place).tobytes() for place in places],
            [[(each.seed, each.fitness, each.steps) for each in results] for results in scored],
            [(each.number, each.mean, each.best, each.sigma, each.steps) for each in history],
            run.evaluations(),
            run.confirmation(),
            np.load(run.controller_path)["parameters"].tobytes(),
        )


def evolve(processes, name, workers, *settings, task=()):
    """The outcome of a run on so many workers, which end with it; they announce this task."""
    coordinator = processes.coordinator(*settings, name=name)
    announced = ("--task", task) if task else ()
    crew = [processes.worker("--run", name, "--name", f"w{number}", *announced) for number in range(workers)]
    assert coordinator.finish(1200)[0] == 0, "".join(line for each in (coordinator, *crew) for line in each.lines)
    for each in crew:
        each.end()
    return outcome(processes, name)


def check_replay(processes, name, candidate, episodes, *more, call=call_here):
    """Assert that a candidate's episodes give the same bits again."""
    words = ("verify", "candidate", name, "--runs-dir", processes.runs, "--candidate", candidate, *more)
    assert printed(*words, call=call).count("same bits") == episodes
