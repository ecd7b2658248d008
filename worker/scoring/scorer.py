"""What a slot does with a job: the task's environment and policy, made once, used for every job."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.common.messages import Kind, TaskSpec
from dreamfleet.common.variants import Variant
from dreamfleet.worker.scoring.episode import Course, score
from dreamfleet.worker.scoring.rollout import Rollout
from dreamfleet.worker.tasks.api import Assignment, Batch, Batched, Score, World
from dreamfleet.worker.tasks.registry import find_task

DRIVER = "controller"  # as a kept rollout names who drove


class Scorer:
    """Scores a slot's jobs.

    >>> from dreamfleet.common.bundle import find_bundle
    >>> bundle = find_bundle("tiny")
    >>> scorer = Scorer(TaskSpec("car-racing", bundle.sha256, horizon=100, patience=0), bundle)  # doctest: +SKIP
    >>> scorer.score("score", np.zeros(867, np.float32), seed=2**20)  # doctest: +SKIP
    """

    def __init__(self, spec: TaskSpec, bundle: Bundle | None = None) -> None:
        task = find_task(spec.task)
        fitting = None if bundle is None else bundle.under(spec.controller, Variant.of(spec.options))
        assignment = Assignment(spec, fitting)
        self.world = checked_world(assignment)
        self.spec = spec
        self._batch_for: Callable[[TaskSpec], Batch] | None = None
        if isinstance(task, Batched):
            make = task.make_batch
            # One is kept: a run's terms change now and then, and making a batch takes milliseconds.
            self._batch_for = lru_cache(maxsize=1)(lambda each: make(Assignment(each, assignment.bundle)))
            self._batch_for(spec)  # so that what is wrong with it shows at once
        self._environment = task.make_environment(assignment)
        self._policy = task.make_policy(assignment)
        self._preprocessing = "" if bundle is None else bundle.manifest.preprocessing

    def score(
        self, kind: Kind, parameters: NDArray[np.float32], seed: int, on_step: Callable[[int], None] = lambda _: None,
        spec: TaskSpec | None = None,
    ) -> Score:  # fmt: skip
        """A candidate's fitness under the run's horizon and patience; an evaluation drives the whole episode.

        `spec` is one other than the run's: the same at another temperature, horizon or patience, or driven.
        """
        if (batch := self._batch((kind,), spec)) is not None:
            return batch.score([(parameters, seed)], on_step)[0]
        return score(self._environment, self._policy, parameters, self.course(kind, seed, spec), on_step)

    def score_all(
        self, jobs: Sequence[tuple[Kind, NDArray[np.float32], int]], on_step: Callable[[int], None],
        spec: TaskSpec | None = None,
    ) -> list[Score]:  # fmt: skip
        """A turn's jobs, as `score` does; `on_step` hears of all steps made so far."""
        if (batch := self._batch([kind for kind, _, _ in jobs], spec)) is not None:
            return batch.score([(parameters, seed) for _, parameters, seed in jobs], on_step)
        scores: list[Score] = []
        for job in jobs:
            before = sum(each.steps for each in scores)
            scores.append(
                self.score(*job, lambda done, before=before: on_step(before + done), spec)  # type: ignore[misc]
            )
        return scores

    def collect(
        self, parameters: NDArray[np.float32], seed: int, on_step: Callable[[int], None] = lambda _: None,
        spec: TaskSpec | None = None,
    ) -> tuple[Score, Rollout]:  # fmt: skip
        """An episode as candidates drive it, and what happened in it, failures included; `spec` as in `score`."""
        rollout = Rollout(DRIVER, self._preprocessing)
        course = self.course("collect", seed, spec)
        return score(self._environment, self._policy, parameters, course, on_step, rollout), rollout

    @property
    def drawn_by(self) -> str:
        """Who draws the environment's picture; `-` where a task does not say."""
        return str(getattr(self._environment.unwrapped, "drawn_by", "-"))

    def course(self, kind: Kind, seed: int, spec: TaskSpec | None = None) -> Course:
        """The episode that a job of this kind and seed is, in the run's specification or in `spec`."""
        if kind == "evaluate":
            return Course(seed, self.world.horizon)
        spec, world = spec or self.spec, self.world
        time_cost, stray_cost = (world.time_cost, world.stray_cost) if kind == "score" else (0.0, 0.0)
        return Course(
            seed, spec.horizon, spec.patience, world.idle_cost, time_cost, world.finish, stray_cost, world.stray
        )

    def _batch(self, kinds: Iterable[Kind], spec: TaskSpec | None) -> Batch | None:
        """What scores jobs of these kinds at once; `None` where they are driven one by one."""
        spec = spec or self.spec
        if self._batch_for is None or spec.driven or any(kind != "score" for kind in kinds):
            return None
        return self._batch_for(spec)

    def close(self) -> None:
        """Release the environment."""
        self._environment.close()


def checked_world(assignment: Assignment) -> World:
    """The world that is scored in; `UsageError` where the task is of another version here."""
    spec, world = assignment.spec, find_task(assignment.spec.task).world_of(assignment)
    if world.version != spec.version:
        raise UsageError(
            f"the run scores in version {spec.version} of task {spec.task}, here is version {world.version}: "
            "install the package version that the run was begun with"
        )
    return world
