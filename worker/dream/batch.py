"""Scoring many candidates in the dream at once; a fitness has the same bits alone, in any batch and in any order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.measures import check_dreamt
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.dream.noise import SharedNoise
from dreamfleet.worker.dream.world import DreamWorld
from dreamfleet.worker.tasks.api import Score
from dreamfleet.worker.tasks.batches import Episode
from dreamfleet.worker.tasks.measures import Measurer
from dreamfleet.worker.tasks.watching import StepObserver, StepSnapshot

DEFAULT_TEMPERATURE = 1.0  # also in the help of `inspect --temperature`
MAX_ROWS = 256  # episodes that are dreamt together: larger batches are slower (docs/explanation/decisions.md)
TORCH_ROWS = 512  # on a torch device: half of what a worker may hold, for the next wait there: docs/lab/measurements.md


class DreamBatch:
    """Scores batches of dreamt episodes."""

    most_rows = MAX_ROWS  # on a torch device TORCH_ROWS: docs/how-to/gpu.md

    def __init__(self, bundle: Bundle, spec: TaskSpec) -> None:
        self._size = bundle.controller_shape.size
        self._horizon = spec.horizon
        self._observer: StepObserver | None = None
        self._world = DreamWorld(bundle, spec.temperature or DEFAULT_TEMPERATURE, spec.recorded, spec.end)
        check_dreamt(spec.measures)
        self._measurer = Measurer(spec.measures, self._world.actions, self._world.action_names)

    def watched(self, observer: StepObserver) -> DreamBatch:
        """A copy that passes steps to `observer`: those of the first episode that has not ended."""
        shown = copy(self)
        shown._observer = observer
        return shown

    def score(self, episodes: Sequence[Episode], on_step: Callable[[int], None] = lambda _: None) -> list[Score]:
        """The score of each episode: the sum of its rewards in step order, in double precision.

        `on_step` gets the number of steps so far, over all episodes.
        """
        scores: list[Score] = []
        for start in range(0, len(episodes), self.most_rows):
            before = sum(score.steps for score in scores)
            tile = episodes[start : start + self.most_rows]
            scores += self._dream(tile, lambda made, before=before: on_step(before + made), start)  # type: ignore[misc]
        return scores

    def _dream(self, episodes: Sequence[Episode], on_step: Callable[[int], None], start: int) -> list[Score]:
        parameters, world, rows = self._stack(episodes), self._world, np.arange(len(episodes))
        noise, sums = self._draw_noise(episodes), self._begin_sums(len(episodes))
        latent, state = noise.first.latent, world.begin(len(rows), noise.first.memory)
        for step in range(self._horizon):
            moment = world.step_controllers(latent, parameters, state, noise.next(rows))
            if self._observer is not None and self._observer.is_due():
                first = int(rows[0])
                seen = StepSnapshot(step, float(sums.fitness[first]), moment.action[0], None, latent[0], state[0])
                self._observer.observe(start + first, lambda seen=seen: seen)  # type: ignore[misc]
            sums.add(rows, moment.reward, moment.action)
            on_step(sums.made)
            latent, state = moment.latent, moment.state
            if moment.done.any():
                going = ~moment.done
                rows, parameters = rows[going], parameters[going]
                latent, state = latent[going], state[going]
            if not len(rows):
                break
        return sums.scores()

    def _stack(self, episodes: Sequence[Episode]) -> NDArray[np.float32]:
        """The controllers' parameters `(rows, size)`; `UsageError` for others than this world model's."""
        parameters = np.stack([vector for vector, _ in episodes]).astype(np.float32)
        if parameters.shape[1] != self._size or not np.isfinite(parameters).all():
            raise UsageError(f"a dream needs controllers of {self._size} finite parameters")
        return parameters

    def _draw_noise(self, episodes: Sequence[Episode]) -> SharedNoise:
        world, seeds = self._world, np.array([seed for _, seed in episodes])
        return SharedNoise(seeds, world.chance, world.start_states, world.bars)

    def _begin_sums(self, rows: int) -> DreamSums:
        return DreamSums(self._measurer, rows)


class DreamSums:
    """The sums of dreams' rewards, steps and measures, one row a dream."""

    def __init__(self, measurer: Measurer, rows: int) -> None:
        self.fitness, self.made = np.zeros(rows), 0
        self._steps = np.zeros(rows, dtype=np.int64)
        self._measurer, self._tally = measurer, measurer.begin(rows)

    def add(self, rows: NDArray[np.int64], reward: NDArray[np.float64], action: NDArray[np.float32]) -> None:
        """Add a step of `rows`: its rewards `(rows,)` and actions `(rows, actions)`."""
        # No world takes such an action, and a model of integers would see a number in it.
        self.fitness[rows] += np.where(np.isfinite(action).all(axis=1), reward, np.nan)
        self._steps[rows] += 1
        self.made += len(rows)
        if self._measurer.names:
            self._tally.add(rows, action)

    def scores(self) -> list[Score]:
        """The score of each row."""
        return [
            Score(float(total), int(count), self._measurer.values(self._tally, row, int(count)))
            for row, (total, count) in enumerate(zip(self.fitness, self._steps, strict=True))
        ]
