"""Drives with disturbed actions, with the true state beside the world model's, and dreams from their steps on."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import UsageError
from dreamfleet.common.runs.seeds import VALIDATION
from dreamfleet.worker.dream.noise import BLOCK_STEPS, Draw, EpisodeNoise, stack_draws
from dreamfleet.worker.dream.world import DreamWorld
from dreamfleet.worker.scoring.actors import Actor
from dreamfleet.worker.scoring.disturbance import Disturbance, DisturbedPolicy, add_disturbance
from dreamfleet.worker.scoring.episode import EpisodeConfig, ResetHook, run_episode
from dreamfleet.worker.tasks.api import Assignment, Task
from dreamfleet.worker.tasks.closing import closing_environment
from dreamfleet.worker.tasks.recordable import TaskWithBeginnings
from dreamfleet.worker.tasks.registry import task_of
from dreamfleet.worker.tasks.true_state import TaskWithTrueState
from dreamfleet.worker.worldmodel.inference import Controllers
from dreamfleet.worker.worldmodel.observation import join_features
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Truth = dict[str, NDArray[np.float64]]
OFF, OFFSET = "off_road", "lateral_offset"  # columns of a world's true state: 1 or 0; distance from the centre line


@dataclass(frozen=True)
class DisturbedDriveConfig:
    """How drives are disturbed, and where they end.

    `noise` is that of `Disturbance`. The road is lost when the car
    is off it for `lasting` steps in a row; a drive ends `after` steps after the first of them. The first `opening`
    steps are not measured: the world's `opening`. `anywhere` begins drives at a random place of their
    world, for drivers that do not get far.
    """

    noise: float = 0.3
    steps: int = 1000
    lasting: int = 10
    after: int = 40
    opening: int = 0
    first_seed: int = VALIDATION.start
    anywhere: bool = False


@dataclass(frozen=True)
class DisturbedDrive:
    """A drive of T steps.

    Before each step: the world model's `latent` (T, latent) and `state` (T, state), the columns of the `truth` (T,).
    Then the `action` (T, actions) including the disturbance `push` (T, actions), and the `reward` (T,). `lost` is the
    first step of the loss of the road that ended the drive, if any. The first `hidden` columns of the state are h.
    """

    seed: int
    latent: Floats
    state: Floats
    hidden: int
    truth: Truth
    action: Floats
    push: Floats
    reward: NDArray[np.float64]
    lost: int | None = None

    def __len__(self) -> int:
        return len(self.action)

    @property
    def features(self) -> Floats:
        """[z, h] of each step `(T, latent + hidden)`: a controller's inputs."""
        return join_features(self.latent, self.state, self.hidden)


class DisturbedDriveRecorder(DisturbedPolicy):
    """A policy that disturbs an actor's actions, and records the true state and the world model's state."""

    def __init__(
        self, recurrent: RecurrentState, actor: Actor, disturbance: Disturbance, truth: Callable[[], dict[str, float]]
    ) -> None:
        super().__init__(actor, disturbance, recurrent)
        self._recurrent, self._truth = recurrent, truth
        self.hidden = recurrent.hidden
        self.true_states: list[dict[str, float]] = []
        self.recorded: list[tuple[Floats, Floats, Floats, Floats]] = []  # latent, state, action and push of a step

    def on_action(self, action: Floats, push: Floats) -> None:
        """Record a step."""
        self.true_states.append(self._truth())
        self.recorded.append((self._recurrent.latent[0], self._recurrent.state[0], action[0], push[0]))


def record_disturbed_drives(
    bundle: Bundle, recurrent: RecurrentState, actor_of: Callable[[int], Actor], config: DisturbedDriveConfig
) -> Iterator[DisturbedDrive]:
    """Record drives without end, one per seed.

    `recurrent` is the bundle's recurrent state, `actor_of` gives the actor of a seed. `UsageError` if the bundle's
    world gives no true state, or its actions are not continuous.
    """
    assignment = Assignment.of(bundle.manifest.task, bundle)
    task = task_of(bundle)
    if not isinstance(task, TaskWithTrueState):
        raise UsageError(
            f"task {task.name} gives no true state to compare with: give it a `truth` (docs/reference/tasks.md)"
        )
    if not isinstance(actions := task.world_of(assignment).actions, Continuous):
        raise UsageError(f"task {task.name} has no continuous actions: its drives cannot be disturbed")
    begin_at = _random_begin(task) if config.anywhere else lambda _seed: None
    with closing_environment(task.make_environment(assignment)) as environment:
        for seed in count(config.first_seed):
            disturbance = Disturbance(seed, actions, config.noise)
            recorder = DisturbedDriveRecorder(recurrent, actor_of(seed), disturbance, lambda: task.truth(environment))
            yield _drive(environment, recorder, EpisodeConfig(seed, config.steps), config, begin_at(seed))


def _random_begin(task: Task) -> Callable[[int], ResetHook]:
    if not isinstance(task, TaskWithBeginnings):
        raise UsageError(f"drives of task {task.name} cannot begin at a random place: give a --controller")
    begin = task.begin_anywhere
    return lambda seed: lambda environment, _seen: begin(environment, np.random.default_rng(seed))


def _drive(
    environment: gymnasium.Env[Any, Any],
    recorder: DisturbedDriveRecorder,
    episode_config: EpisodeConfig,
    config: DisturbedDriveConfig,
    begin: ResetHook | None,
) -> DisturbedDrive:
    recorder.begin()
    truth, rewards, lost, off = recorder.true_states, [], None, 0
    for moment in run_episode(environment, recorder, episode_config, begin):
        rewards.append(moment.reward)
        off = off + 1 if truth[-1].get(OFF) else 0
        if lost is None and off == config.lasting:
            lost = moment.step - config.lasting
        if lost is not None and moment.step >= lost + config.after:
            break
    columns = {name: np.array([each[name] for each in truth]) for name in truth[0]}
    latent, state, action, push = map(np.stack, zip(*recorder.recorded, strict=True))
    return DisturbedDrive(
        episode_config.seed, latent, state, recorder.hidden, columns, action, push, np.array(rewards), lost
    )


def first_sustained(off: NDArray[np.bool_], lasting: int) -> NDArray[np.int64]:
    """The first step `(rows,)` at which each row `(rows, T)` is off for `lasting` steps in a row; -1 if never."""
    if off.shape[1] < lasting:
        return np.full(len(off), -1)
    stays: NDArray[np.bool_] = np.all(np.lib.stride_tricks.sliding_window_view(off, lasting, axis=1), axis=2)
    return np.where(stays.any(axis=1), stays.argmax(axis=1), -1)


@dataclass(frozen=True)
class DreamSegment:
    """A drive's step at which dreams begin, and their length in steps."""

    drive: DisturbedDrive
    step: int
    length: int

    @property
    def steps(self) -> slice:
        """The drive's steps that the dreams replace."""
        return slice(self.step, self.step + self.length)


class DriveDreamer:
    """Dreams from real states on, under a controller with the real disturbance or under the drive's own actions."""

    def __init__(self, bundle: Bundle, controller: Controller, temperature: float, rows: int) -> None:
        fitting = bundle.for_controller(controller)
        self._world, self._controllers = DreamWorld(fitting, temperature), Controllers(fitting)
        self._hidden = bundle.manifest.hidden
        self._parameters = np.repeat(controller.parameters[None], rows, axis=0)

    def dream(self, segment: DreamSegment, *, own: bool) -> tuple[Floats, Doubles]:
        """Return [z, h] `(dreams, steps, features)`, real at the first step, and rewards `(dreams, steps)`.

        With `own` the controller chooses the actions; otherwise the drive's actions are repeated. After its end a dream
        repeats its last state with reward 0.
        """
        drive, rows, features, rewards = segment.drive, len(self._parameters), list[Floats](), list[Doubles]()
        noises = [
            EpisodeNoise((drive.seed << 20) + segment.step * rows + row, self._world.chance, self._world.bars)
            for row in range(rows)
        ]
        latent, state = (np.repeat(each[segment.step][None], rows, axis=0) for each in (drive.latent, drive.state))
        going, actions = np.ones((rows, 1), dtype=bool), self._world.actions
        for action, push in zip(drive.action[segment.steps], drive.push[segment.steps], strict=True):
            features.append(join_features(latent, state, self._hidden))
            chosen = self._controllers.act(self._parameters, latent, state) if own else None
            done = np.repeat(action[None], rows, axis=0)
            if chosen is not None:
                done = add_disturbance(actions, chosen, push[None])
            draw = stack_draws([noise.next() for noise in noises], axis=0).map(np.concatenate)
            moment = self._world.imagine(latent, done, state, draw, chosen)
            rewards.append(np.where(going[:, 0], moment.reward, 0.0))
            latent, state = np.where(going, moment.latent, latent), np.where(going, moment.state, state)
            going = going & ~moment.done[:, None]
        return np.stack(features, axis=1), np.stack(rewards, axis=1)

    def predict_next(self, drive: DisturbedDrive) -> tuple[Floats, Doubles]:
        """Predict each step from the real step before: [z, h] `(T, features)` and rewards `(T,)`.

        z is the dreamt one, except for the first step's, which is real; h is real.
        """
        noise = EpisodeNoise(drive.seed, self._world.chance, self._world.bars)
        moment = self._world.imagine(drive.latent, drive.action, drive.state, draw_rows(noise, len(drive)))
        latent = np.concatenate([drive.latent[:1], moment.latent[:-1]])
        return join_features(latent, drive.state, self._hidden), moment.reward


def draw_rows(noise: EpisodeNoise, rows: int) -> Draw:
    """One step's random numbers for so many rows, which differ."""
    pieces = [noise.draw_block() for _ in range(0, rows, BLOCK_STEPS)]
    return stack_draws(pieces, axis=0).map(lambda part: part.reshape(-1, part.shape[-1])[:rows])
