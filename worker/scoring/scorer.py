"""What a slot does with a job: the task's environment and policy, made once, used for every job."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import cached_property, lru_cache
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.car_racing_variants import Variant
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.protocol.host_classes import class_from_fingerprint
from dreamfleet.common.protocol.messages import Kind, TaskSpec
from dreamfleet.worker.scoring.episode import EpisodeConfig, score
from dreamfleet.worker.scoring.host_class_probe import HostClassProbe
from dreamfleet.worker.scoring.rollout import Rollout
from dreamfleet.worker.scoring.watched_policy import WatchedPolicy
from dreamfleet.worker.tasks.api import Assignment, Batch, BatchedTask, Score, StepObserver, Task, WatchableBatch, World
from dreamfleet.worker.tasks.registry import find_task

DRIVER_NAME = "controller"  # as a kept rollout names who drove


class Scorer:
    """Scores a slot's jobs.

    >>> from dreamfleet import Scorer, TaskSpec, find_bundle, find_controller
    >>> bundle = find_bundle("tiny")
    >>> scorer = Scorer(TaskSpec("car-racing", bundle.sha256, horizon=20, patience=0), bundle)
    >>> score = scorer.score("score", find_controller("tiny").parameters, seed=2**20)
    >>> score.steps
    20
    >>> scorer.close()
    """

    def __init__(self, spec: TaskSpec, bundle: Bundle | None = None) -> None:
        self.observer: StepObserver | None = None  # to be set between turns; `None` costs an episode nothing
        task = find_task(spec.task)
        fitting = None if bundle is None else bundle.with_controllers(spec.controller, Variant.from_json(spec.options))
        assignment = Assignment(spec, fitting)
        self.world = find_checked_world(assignment)
        self.spec = spec
        self._batch_for: Callable[[TaskSpec], Batch] | None = None
        if isinstance(task, BatchedTask):
            make = task.make_batch
            # One is kept: a run's terms change now and then, and making a batch takes milliseconds.
            self._batch_for = lru_cache(maxsize=1)(lambda each: make(Assignment(each, assignment.bundle)))
            self._batch_for(spec)  # so that what is wrong with it shows at once
        self._task, self._assignment = task, assignment
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
        return self.score_all([(kind, parameters, seed)], on_step, spec)[0]

    def score_all(
        self, jobs: Sequence[tuple[Kind, NDArray[np.float32], int]], on_step: Callable[[int], None],
        spec: TaskSpec | None = None,
    ) -> list[Score]:  # fmt: skip
        """A turn's jobs, as `score` does; `on_step` hears of all steps made so far."""
        if (batch := self._batch([kind for kind, _, _ in jobs], spec)) is not None:
            if self.observer is not None and isinstance(batch, WatchableBatch):
                batch = batch.watched(self.observer)
            return batch.score([(parameters, seed) for _, parameters, seed in jobs], on_step)
        scores: list[Score] = []
        for kind, parameters, seed in jobs:
            before = sum(each.steps for each in scores)

            def report_steps(done: int, before: int = before) -> None:
                on_step(before + done)

            if (alone := self._batch((kind,), spec)) is not None:
                scores += alone.score([(parameters, seed)], report_steps)
            else:
                scores.append(
                    self._run_episode(len(scores), parameters, self.episode_config(kind, seed, spec), report_steps)
                )
        return scores

    def collect(
        self, parameters: NDArray[np.float32], seed: int, on_step: Callable[[int], None] = lambda _: None,
        spec: TaskSpec | None = None,
    ) -> tuple[Score, Rollout]:  # fmt: skip
        """An episode as candidates drive it, and what happened in it, failures included; `spec` as in `score`."""
        rollout = Rollout(DRIVER_NAME, self._preprocessing)
        episode_config = self.episode_config("collect", seed, spec)
        return self._run_episode(0, parameters, episode_config, on_step, rollout), rollout

    @property
    def drawn_by(self) -> str:
        """Who draws the environment's picture; `-` where a task does not say."""
        return str(getattr(self._environment.unwrapped, "drawn_by", "-"))

    @cached_property
    def host_class(self) -> str:
        """The class of this host, as far as this task shows it: hosts of one compute the same bits.

        Where nobody may look, or the task fails at it, the host's fingerprint tells it.
        """
        steps = getattr(self._task, "probe_steps", Task.probe_steps)
        found, size = HostClassProbe(), self._assignment.controller.size
        with suppress(Exception):  # a job that is to be scored will tell what is wrong, and to whom it matters
            if steps > 0:
                found.add_episode(self._environment, self._policy, size, steps)
                if self._batch_for is not None:
                    found.add_batch(self._batch_for(self.spec.with_overrides(horizon=steps)), size)
                return found.host_class
        return class_from_fingerprint(fingerprint(self.world.packages))

    def episode_config(self, kind: Kind, seed: int, spec: TaskSpec | None = None) -> EpisodeConfig:
        """The episode that a job of this kind and seed is, in the run's specification or in `spec`."""
        if kind == "evaluate":
            return EpisodeConfig(seed, self.world.horizon)
        spec, world = spec or self.spec, self.world
        time_cost, stray_cost = (world.time_cost, world.stray_cost) if kind == "score" else (0.0, 0.0)
        return EpisodeConfig(
            seed, spec.horizon, spec.patience, world.idle_cost, time_cost, world.finish, stray_cost, world.stray
        )

    def _batch(self, kinds: Iterable[Kind], spec: TaskSpec | None) -> Batch | None:
        """What scores jobs of these kinds at once; `None` where they are driven one by one."""
        spec = spec or self.spec
        if self._batch_for is None or spec.driven or any(kind != "score" for kind in kinds):
            return None
        return self._batch_for(spec)

    def close(self) -> None:
        """Release the environments."""
        self._environment.close()
        if (watched := self.__dict__.get("_watched_environment")) is not None:  # made when somebody first watches
            watched.close()

    def _run_episode(
        self,
        episode: int,
        parameters: NDArray[np.float32],
        episode_config: EpisodeConfig,
        on_step: Callable[[int], None],
        rollout: Rollout | None = None,
    ) -> Score:
        """Drive an episode, the one of this place in the turn, before the onlooker's eyes if there is one."""
        if self.observer is None:
            return score(self._environment, self._policy, parameters, episode_config, on_step, rollout)
        shown = self._watched_environment
        policy = WatchedPolicy(self._policy, self.observer, episode, None if shown is None else shown.render)
        environment = self._environment if shown is None else shown
        return score(environment, policy, parameters, episode_config, on_step, rollout)

    @cached_property
    def _watched_environment(self) -> gymnasium.Env[Any, Any] | None:
        """What is scored in while somebody looks on, if that is another environment; one that cannot be had is none."""
        with suppress(Exception):
            return self._task.make_shown(self._assignment)
        return None


def find_checked_world(assignment: Assignment) -> World:
    """The world that is scored in; `UsageError` where the task is of another version here."""
    spec, world = assignment.spec, find_task(assignment.spec.task).world_of(assignment)
    if world.version != spec.version:
        raise UsageError(
            f"the run scores in version {spec.version} of task {spec.task}, here is version {world.version}: "
            "install the package version that the run was begun with"
        )
    return world
