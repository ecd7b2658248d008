"""Scoring jobs in a slot, with an environment and a policy that are made once."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, lru_cache
from time import monotonic
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.host_classes import NON_DETERMINISTIC, class_from_fingerprint
from dreamfleet.common.protocol.messages import MAX_SIDE_BY_SIDE, Kind, TaskSpec
from dreamfleet.common.schema.display import Displayed
from dreamfleet.worker.scoring.episode import EpisodeConfig, score, score_side_by_side
from dreamfleet.worker.scoring.host_class_probe import REPEAT_LIMIT, HostClassProbe
from dreamfleet.worker.scoring.rollout import DataWorld, Rollout
from dreamfleet.worker.scoring.watched_policy import WatchedPolicy
from dreamfleet.worker.tasks.api import Assignment, Score, Task, World
from dreamfleet.worker.tasks.batches import Batch, BatchedTask, WatchableBatch
from dreamfleet.worker.tasks.closing import close_environment
from dreamfleet.worker.tasks.measures import EpisodeMeasurer, Measurer
from dreamfleet.worker.tasks.registry import find_scored_task
from dreamfleet.worker.tasks.side_by_side import Policies, PolicySideBySide
from dreamfleet.worker.tasks.watching import StepObserver

DRIVER_NAME = "controller"  # the driver's name in collected rollouts


class Scorer(Displayed):
    """Scores jobs of one specification, and of variants of it.

    `UsageError` or `BundleError` if the task, its version or the world model does not fit this host.

    >>> from dreamfleet import Scorer, TaskSpec, find_bundle, find_controller
    >>> bundle = find_bundle("tiny")
    >>> scorer = Scorer(TaskSpec("car-racing", bundle.sha256, horizon=20, patience=0), bundle)
    >>> score = scorer.score("score", find_controller("tiny").parameters, seed=2**20)
    >>> score.steps
    20
    >>> scorer
    <Scorer of car-racing: 867 parameters, episodes of 20 steps at most>
    >>> scorer.close()
    """

    def __init__(self, spec: TaskSpec, bundle: Bundle | None = None, torch_device: str = "") -> None:
        """With a `torch_device`, such as "cuda", dreams are dreamt there."""
        self.observer: StepObserver | None = None  # of steps of the next jobs; `None` costs an episode nothing
        task = find_scored_task(spec.task, bundle)
        fitting = None if bundle is None else bundle.with_options(spec.controller, spec.options)
        assignment = Assignment(spec, fitting, torch_device)
        self.spec = spec
        self._task, self._assignment = task, assignment
        # First of all, so that nothing else makes one to ask for the world: many simulators allow one a process.
        self._environment = task.make_environment(assignment)
        self._more_environments: list[gymnasium.Env[Any, Any]] = []  # for episodes that are driven side by side
        try:
            self._prepare()
        except BaseException:
            self.close()
            raise

    def _prepare(self) -> None:
        """Check the world, and make what scores in it."""
        spec, task, assignment = self.spec, self._task, self._assignment
        self.world = find_checked_world(assignment)
        self._batch_for: Callable[[TaskSpec], Batch] | None = None
        if isinstance(task, BatchedTask):
            make = task.make_batch
            # The last batch is kept: specifications change rarely, and making a batch takes milliseconds.
            self._batch_for = lru_cache(maxsize=1)(lambda each: make(replace(assignment, spec=each)))
            self._batch_for(spec)  # raises its errors now, not with the first job
        self._policy = task.make_policy(assignment)
        self._policies: Policies | None = None
        truth = getattr(task.reality(assignment), "truth", None)
        self._measurer = Measurer(spec.measures, self.world.actions, self.world.action_names, truth)
        bundle = assignment.bundle
        self._preprocessing = "" if bundle is None else bundle.manifest.preprocessing
        self._data_world = DataWorld(spec.task, spec.options) if bundle is None else DataWorld.of(bundle)

    def _display(self) -> tuple[str, dict[str, object]]:
        spec, size = self.spec, self._assignment.controller.size
        title = (
            f"Scorer of {spec.task}: {plural(size, 'parameter')}, episodes of {plural(spec.horizon, 'step')} at most"
        )
        return title, {
            "task": spec.task,
            "parameters": size,
            "horizon": spec.horizon,
            "patience": spec.patience,
            "temperature": spec.temperature,
            "world model": spec.bundle[:12] or "none",
            "options": spec.options or None,
        }

    def score(
        self, kind: Kind, parameters: NDArray[np.float32], seed: int, on_step: Callable[[int], None] = lambda _: None,
        spec: TaskSpec | None = None,
    ) -> Score:  # fmt: skip
        """A candidate's score under the run's horizon and patience, or, for `evaluate`, in a whole episode.

        `parameters` `(size,)`. `spec` replaces the run's specification; it may differ in horizon, patience and
        whether episodes are driven. `on_step` gets the number of steps so far.
        """
        return self.score_all([(kind, parameters, seed)], on_step, spec)[0]

    def score_all(
        self, jobs: Sequence[tuple[Kind, NDArray[np.float32], int]], on_step: Callable[[int], None],
        spec: TaskSpec | None = None,
    ) -> list[Score]:  # fmt: skip
        """The scores of several jobs, as `score`; `on_step` gets the number of steps so far, over all jobs."""
        if (batch := self._batch([kind for kind, _, _ in jobs], spec)) is not None:
            if self.observer is not None and isinstance(batch, WatchableBatch):
                batch = batch.watched(self.observer)
            return batch.score([(parameters, seed) for _, parameters, seed in jobs], on_step)
        if 1 < len(jobs) <= self.side_by_side and self.observer is None:
            assert self._policies is not None  # `side_by_side` has made them
            return score_side_by_side(
                (self._environment, *self._more_environments), self._policies,
                [parameters for _, parameters, _ in jobs],
                [self.episode_config(kind, seed, spec) for kind, _, seed in jobs], on_step,
            )  # fmt: skip
        scores: list[Score] = []
        for kind, parameters, seed in jobs:
            before = sum(each.steps for each in scores)

            def report_steps(done: int, before: int = before) -> None:
                on_step(before + done)

            if (alone := self._batch((kind,), spec)) is not None:
                scores += alone.score([(parameters, seed)], report_steps)
            else:
                episode_config = self.episode_config(kind, seed, spec)
                scores.append(self._run_episode(len(scores), parameters, episode_config, report_steps))
        return scores

    def collect(
        self, parameters: NDArray[np.float32], seed: int, on_step: Callable[[int], None] = lambda _: None,
        spec: TaskSpec | None = None,
    ) -> tuple[Score, Rollout]:  # fmt: skip
        """Score and recording of an episode under the run's horizon and patience; `spec` as in `score`."""
        rollout = Rollout(DRIVER_NAME, self._preprocessing, self._data_world)
        episode_config = self.episode_config("collect", seed, spec)
        return self._run_episode(0, parameters, episode_config, on_step, rollout), rollout

    @property
    def drawn_by(self) -> str:
        """What draws the environment's pictures; `-` if the task does not say."""
        return str(getattr(self._environment.unwrapped, "drawn_by", "-"))

    @cached_property
    def host_class(self) -> str:
        """The class of this host: hosts of one class compute the same bits in this task.

        `NON_DETERMINISTIC` if a second probe episode computes other bits than the first one. Without a probe episode
        (`probe_steps` 0), or if it fails, the class comes from the host's fingerprint.
        """
        steps = getattr(self._task, "probe_steps", Task.probe_steps)
        with suppress(BaseException):  # `SystemExit` too: the first job will report the same error
            if steps > 0:
                began = monotonic()
                found = self._probe(steps)
                repeat = monotonic() - began < REPEAT_LIMIT
                return found if not repeat or self._probe(steps) == found else NON_DETERMINISTIC
        return class_from_fingerprint(fingerprint(self.world.packages, self._assignment.torch_device))

    def _probe(self, steps: int) -> str:
        found, size = HostClassProbe(), self._assignment.controller.size
        found.add_episode(self._environment, self._policy, size, steps)
        if self._batch_for is not None:
            found.add_batch(self._batch_for(self.spec.with_overrides(horizon=steps)), size)
        return found.host_class

    def episode_config(self, kind: Kind, seed: int, spec: TaskSpec | None = None) -> EpisodeConfig:
        """The episode of a job with this kind and seed, in the run's specification or in `spec`."""
        if kind == "evaluate":
            return EpisodeConfig(seed, self.world.horizon)
        spec, world = spec or self.spec, self.world
        time_cost, off_course_cost = (world.time_cost, world.off_course_cost) if kind == "score" else (0.0, 0.0)
        return EpisodeConfig(
            seed, spec.horizon, spec.patience, world.idle_cost, time_cost, world.finish, off_course_cost,
            world.off_course,
        )  # fmt: skip

    def _batch(self, kinds: Iterable[Kind], spec: TaskSpec | None) -> Batch | None:
        """The batch that scores jobs of these kinds; `None` if they are driven one by one."""
        spec = spec or self.spec
        if self._batch_for is None or spec.driven or any(kind != "score" for kind in kinds):
            return None
        return self._batch_for(spec)

    def close(self) -> None:
        """Release the environments."""
        for environment in (self._environment, *self._more_environments):
            close_environment(environment)
        if (watched := self.__dict__.get("_watched_environment")) is not None:  # made on first use
            close_environment(watched)

    @cached_property
    def side_by_side(self) -> int:
        """How many candidates' drives it does side by side. Their environments are made when this is first asked."""
        reality, policy = self._task.reality(self._assignment), self._policy
        if self.spec.measures or isinstance(reality, BatchedTask) or not isinstance(policy, PolicySideBySide):
            return 1
        with suppress(BaseException):  # then they are driven one by one; `SystemExit` too, of a simulator
            self._policies = policy.side_by_side()
            for _ in range(min(reality.batch_size, MAX_SIDE_BY_SIDE) - 1):
                self._more_environments.append(self._task.make_environment(self._assignment))
            return 1 + len(self._more_environments)
        return 1

    def _run_episode(
        self, episode: int, parameters: NDArray[np.float32], episode_config: EpisodeConfig,
        on_step: Callable[[int], None], rollout: Rollout | None = None,
    ) -> Score:  # fmt: skip
        """Drive the episode with this index in its group, and let the observer watch if there is one."""
        environment, policy = self._environment, self._policy
        if self.observer is not None:
            shown = self._watched_environment
            policy = WatchedPolicy(policy, self.observer, episode, None if shown is None else shown.render)
            environment = environment if shown is None else shown
        if not self.spec.measures:
            return score(environment, policy, parameters, episode_config, on_step, rollout)
        watch = EpisodeMeasurer(self._measurer, environment)
        found = score(
            environment, policy, parameters, episode_config, on_step, rollout,
            lambda moment: watch.on_transition(moment.action, moment.info),
        )  # fmt: skip
        return replace(found, measures=watch.values)

    @cached_property
    def _watched_environment(self) -> gymnasium.Env[Any, Any] | None:
        """The task's environment for watched episodes; `None` if there is none or it cannot be made."""
        with suppress(BaseException):
            return self._task.make_watched_environment(self._assignment)
        return None


def find_checked_world(assignment: Assignment) -> World:
    """The world that is scored in; `UsageError` if the task has another version on this host."""
    spec, task = assignment.spec, find_scored_task(assignment.spec.task, assignment.bundle)
    world = task.world_of(assignment)
    if world.version != spec.world_version:
        raise UsageError(
            f"the run scores in version {spec.world_version} of task {spec.task}, here is version {world.version}: "
            "install the package version that the run was begun with"
        )
    return world
