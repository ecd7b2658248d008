"""What is true of a run whatever happens to it: what every episode gives, and what a fleet without faults computes.

Restated here from the protocol, apart from the product's own code, so that a fault in that is not a fault in both.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.protocol.messages import Job, TaskSpec
from dreamfleet.common.runs.records import RunSettings, StageSettings, StoredEvaluation
from dreamfleet.common.runs.seeds import collection_seed, search_seed, training_seed, validation_seeds
from dreamfleet.coordinator.optimisers.api import Search
from tests.simulation.schedule import Shape

STEPS = 100  # of every episode
TASK = "simulated"
SECOND_HORIZON, SECOND_PATIENCE, SECOND_SIGMA = 2 * STEPS, 7, 0.25  # of a second stage
# Settings that a shape calls as a run does.
EQUAL = (
    "population", "episodes", "evaluate_every", "evaluation_episodes", "racing", "confirm_episodes", "collect_every",
    "on_failure",
)  # fmt: skip
MAX_RETRIES = 3  # times that a generation gets other seeds, and that its failed candidates are drawn anew


class HopelessError(Exception):
    """All candidates of a generation fail whatever is tried: the run would wait for somebody to change the task."""


Named = tuple[int | None, int | None, bool | None]  # nothing is driven where nothing dreams
"""Horizon and patience of a job, and whether it is driven, where they are not the run's."""


class Strategy:
    """A search that is cheap, exact, and depends on every bit of the fitness."""

    requirement = "simulated==1"
    options: ClassVar[Mapping[str, str]] = {}

    def __init__(self, search: Search) -> None:
        self._search = search
        self.mean, self.sigma, self._count = search.mean, search.sigma0, 0

    def ask(self) -> Any:
        source = np.random.Generator(np.random.PCG64([self._search.seed, self._count]))
        steps = source.standard_normal((self._search.population, self._search.dimension), dtype=np.float32)
        self._asked, self._redraws = self.mean + self.sigma * steps, 0
        return self._asked

    def redraw(self, indices: Sequence[int]) -> Any:
        self._redraws += 1
        source = np.random.Generator(np.random.PCG64([self._search.seed, self._count, self._redraws]))
        steps = source.standard_normal((len(indices), self._search.dimension), dtype=np.float32)
        self._asked[list(indices)] = self.mean + self.sigma * steps
        return self._asked[list(indices)]

    def tell(self, fitness: Any) -> None:
        self.mean = fitness @ self._asked / fitness.sum()
        self.sigma, self._count = self.sigma * 0.99, self._count + 1

    def prepare(self) -> None:
        pass

    def state(self) -> dict[str, Any]:
        return {"mean": self.mean, "sigma": np.array(self.sigma), "count": np.array(self._count)}

    def restore(self, state: Mapping[str, Any]) -> None:
        self.mean, self.sigma, self._count = state["mean"], float(state["sigma"]), int(state["count"])


@lru_cache(4096)
def settings_of(shape: Shape) -> RunSettings:
    """The frozen settings of the run."""
    equal = {name: getattr(shape, name) for name in EQUAL}
    controller = ControllerShape(shape.parameters // 2 - 1, 2)
    fixed = {"task": TaskSpec(TASK, "", STEPS, 0), "sigma0": 0.5, "covariance": "diagonal", "optimiser": TASK}
    return RunSettings(controller=controller, seed=shape.run_seed, stages=_stages_of(shape), **fixed, **equal)


def _stages_of(shape: Shape) -> tuple[StageSettings, ...]:
    if not shape.first_stage:
        return ()
    anew = {"population": shape.population + 1, "sigma0": SECOND_SIGMA} if shape.anew else {}
    scored = {"horizon": SECOND_HORIZON, "patience": SECOND_PATIENCE, "racing": not shape.racing}
    first = StageSettings(shape.first_stage, score=shape.first_score or None)
    return first, StageSettings(episodes=shape.episodes + 1, **scored, **anew)  # type: ignore[arg-type]


def fitness_of(vector: bytes, seed: int, named: Named) -> float:
    """What an episode gives: a function of the parameters' bytes, the seed and what is named, and of nothing else."""
    return _fitness(hashlib.sha256(vector).digest(), seed, named)


def fitness_of_job(job: Job) -> float:
    """What an episode of this job gives, if its vector is what it says."""
    return _fitness(job.vector, job.seeds[0], job.overrides)


def fails(share: float, vector: bytes, seed: int) -> bool:
    """Whether a candidate's episode fails wherever it is scored; `vector` is the digest of the parameters."""
    hashed = hashlib.blake2b(b"fails" + vector + str(seed).encode(), digest_size=4).digest()
    return int.from_bytes(hashed, "little") < share * 2**32


def _fitness(identity: bytes, seed: int, named: Named) -> float:
    content = seed, None, *(named if any(named) else ())
    hashed = hashlib.blake2b(identity + repr(content).encode(), digest_size=4).digest()
    return 1.0 + int.from_bytes(hashed, "little") / 2**32


def rollout_of(vector: bytes, seed: int, size: int) -> bytes:
    """The file that a collected episode leaves."""
    return (hashlib.blake2b(vector + str(seed).encode()).digest() * (size // 64 + 1))[:size]


@dataclass(frozen=True)
class Truth:
    """An undisturbed run, generation by generation."""

    vectors: list[tuple[bytes, ...]]  # as they were first asked for
    redrawn: list[list[tuple[bytes, ...]]]  # after each round in which failed candidates were drawn anew
    fitness: list[list[float | None]]  # `None`: it failed
    evaluations: dict[int, StoredEvaluation]
    rollouts: dict[str, bytes]  # by the name of their file
    jobs: int  # that are counted


def truth_of(shape: Shape) -> Truth:
    """What a run of this shape comes to; how many work on it does not matter."""
    return _truth(replace(shape, workers=1, slots=1, width=1, turn=1.0, verify=0.0, ends=True))


@lru_cache(1024)
def _truth(shape: Shape) -> Truth:
    settings = settings_of(shape)
    strategy = Strategy(Search(np.zeros(settings.controller.size), shape.population, settings.sigma0, shape.run_seed))
    truth, counted, second = Truth([], [], [], {}, {}, 0), set(), False
    for number in range(shape.generations):
        named: Named = (None, None, None)
        episodes, racing = shape.episodes, shape.racing
        if not second and _first_is_over(shape, number, truth.evaluations):
            second = True
            strategy = _second_search(shape, strategy) if shape.anew else strategy
        if second:
            named, episodes, racing = (SECOND_HORIZON, SECOND_PATIENCE, None), episodes + 1, not racing
        vectors = tuple(row.astype("<f4").tobytes() for row in strategy.ask())
        truth.vectors.append(vectors)
        vectors, seeds, fitness, driven = _scored(
            shape, strategy, number, list(vectors), named, episodes, racing, truth
        )
        truth.fitness.append([None if np.isnan(each) else each for each in fitness])
        counted |= {("score", vectors[candidate], seeds[episode]) for candidate, episode in driven}
        strategy.tell(np.where(np.isnan(fitness), np.nextafter(np.nanmin(fitness), -np.inf), fitness))
        last = number == shape.generations - 1
        mean = strategy.mean.astype("<f4").tobytes()
        if _due(shape.evaluate_every, number, last and shape.ends):
            tracks = validation_seeds(shape.evaluation_episodes)
            values = np.array([fitness_of(mean, seed, (None, None, None)) for seed in tracks])
            truth.evaluations[number] = StoredEvaluation(number, len(tracks), float(values.mean()), float(values.std()))
            counted |= {("evaluate", mean, seed) for seed in tracks}
        if _due(shape.collect_every, number, last and shape.ends):
            seed = collection_seed(shape.run_seed, number, 0)
            truth.rollouts[f"{number:06d}-0000.npz"] = rollout_of(mean, seed, shape.rollout)
            counted.add(("collect", mean, seed))
    # A further generation is asked for at the end, so that a run with wider limits could go on from it.
    if not second and shape.anew and _first_is_over(shape, shape.generations, truth.evaluations):
        strategy = _second_search(shape, strategy)
    truth.vectors.append(tuple(row.astype("<f4").tobytes() for row in strategy.ask()))
    return replace(truth, jobs=len(counted))


def _first_is_over(shape: Shape, number: int, evaluations: Mapping[int, StoredEvaluation]) -> bool:
    """Whether a second stage begins with generation `number`, or began before it."""
    if not shape.first_stage or number >= shape.first_stage:
        return shape.first_stage > 0
    every = shape.evaluate_every
    old = [each for each in evaluations if each % every == every - 1 and each + 1 + every <= number]
    return shape.first_score > 0 and any(evaluations[each].mean >= shape.first_score for each in old)


def _second_search(shape: Shape, first: Strategy) -> Strategy:
    return Strategy(Search(first.mean, shape.population + 1, SECOND_SIGMA, search_seed(shape.run_seed, 2)))


def _scored(
    shape: Shape, strategy: Strategy, number: int, vectors: list[bytes], named: Named, episodes: int, racing: bool,
    truth: Truth,
) -> tuple[list[bytes], list[int], list[float], set[tuple[int, int]]]:  # fmt: skip
    """A generation's last vectors and seeds, its fitness (NaN: failed) and what was driven for it.

    Bad seeds are replaced, then failed candidates drawn anew, three times each at most.
    """
    reseeds, rounds = 0, list[tuple[bytes, ...]]()
    truth.redrawn.append(rounds)
    while True:
        seeds = [training_seed(shape.run_seed, number, reseeds * episodes + each) for each in range(episodes)]
        scores = [[_score(shape.failing, vector, seed, named) for seed in seeds] for vector in vectors]
        fitness, driven, whole = _fitness_and_driven(scores, racing)
        failed = [each for each, value in enumerate(fitness) if np.isnan(value)]
        if whole <= set(failed) and reseeds < MAX_RETRIES:
            reseeds += 1
        elif failed and shape.on_failure == "redraw" and len(rounds) < MAX_RETRIES:
            for each, row in zip(failed, strategy.redraw(failed), strict=True):
                vectors[each] = row.astype("<f4").tobytes()
            rounds.append(tuple(vectors))
        elif len(failed) == len(fitness):
            raise HopelessError
        else:
            return vectors, seeds, fitness, driven


def _score(failing: float, vector: bytes, seed: int, named: Named) -> float:
    is_failed = fails(failing, hashlib.sha256(vector).digest(), seed)
    return np.nan if is_failed else fitness_of(vector, seed, named)


def _fitness_and_driven(
    scores: list[list[float]], racing: bool
) -> tuple[list[float], set[tuple[int, int]], set[int]]:  # fmt: skip
    """The mean of each candidate's own episodes, which those are, and which candidates were to drive all episodes.

    A failed candidate's fitness is NaN, and none of its episodes is needed.
    """
    episodes = len(scores[0])
    first = (episodes + 1) // 2 if racing else episodes
    early = [-np.inf if np.isnan(row[:first]).any() else float(np.mean(row[:first])) for row in scores]
    order = sorted(range(len(scores)), key=lambda candidate: (-early[candidate], candidate))
    further = set(order[: (len(scores) + 1) // 2]) if first < episodes else set(order)
    own = [row if candidate in further else row[:first] for candidate, row in enumerate(scores)]
    fitness = [float(np.mean(row)) for row in own]
    driven = {(candidate, episode) for candidate, row in enumerate(own) for episode in range(len(row))
              if not np.isnan(fitness[candidate])}  # fmt: skip
    return fitness, driven, further


def _due(every: int, number: int, last: bool) -> bool:
    return every > 0 and (number % every == every - 1 or last)
