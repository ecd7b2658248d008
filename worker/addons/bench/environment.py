"""Benchmark our CarRacing against gymnasium's, and check that the two are equal. Pages: determinism.md."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from time import perf_counter
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import find_bundle, pretrained_folder
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import ControllerError
from dreamfleet.common.runs.seeds import VALIDATION
from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode, score_side_by_side
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.worldmodel.policy import ModelPolicy
from dreamfleet.worker.worlds.car_racing.native_check import (
    ActionSource,
    Mismatch,
    compare,
    make_car_racing,
    random_action,
)
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX
from dreamfleet.worker.worlds.car_racing.task import CarRacingTask, make_reference_environment

STEPS = 1000
Policy = Callable[[NDArray[np.uint8]], Any]


def bench_env(bundle: Bundle, rounds: int) -> dict[str, Any]:
    """Time whole episodes of each case in turn, reset and opening zoom included; return ratios of median step times.

    All cases repeat the same actions, which the shipped controller chose on that track beforehand. A fitness step is
    one of as many episodes as a slot drives side by side, each on a track of its own; `fitness_step_alone` is one of a
    single episode.
    """
    cases, notes = _cases(bundle)
    times: dict[str, list[float]] = {name: [] for name in (*cases, "fitness_step")}
    together = CarRacingTask.batch_size
    for round_number in range(rounds):
        first_seed = VALIDATION.start + together * round_number
        recorded_drives = [record_drive(first_seed + number) for number in range(together)]
        for name, measure in cases.items():
            times[name].append(measure(recorded_drives[0]))
        times["fitness_step"].append(seconds_a_step_side_by_side(bundle, recorded_drives))
    seconds = {name: statistics.median(values) for name, values in times.items()}

    def ratio(slow: str, fast: str) -> float | None:
        return round(seconds[slow] / seconds[fast], 2) if slow in seconds else None

    return {
        "exact": all(compare(seed, 100, random_action) is None for seed in range(2)),
        "ratio_observation": ratio("gymnasium", "observation"),
        "ratio_picture": ratio("gymnasium_picture", "picture"),
        "ratio_envpool": ratio("envpool", "observation"),
        "ratio_fitness_step": ratio("torch_fitness_step", "fitness_step"),
        "microseconds_a_step": {name: round(value * 1e6, 1) for name, value in seconds.items()},
        "episodes": rounds,
        **({"notes": notes} if notes else {}),
    }


def _cases(bundle: Bundle) -> tuple[dict[str, Callable[[RecordedDrive], float]], list[str]]:
    """The cases to measure by name, and a note for each case that lacks a package."""
    task, assignment = CarRacingTask(), Assignment.of(CarRacingTask.name, bundle)
    cases: dict[str, Callable[[RecordedDrive], float]] = {
        "gymnasium": lambda recorded_drive: seconds_a_step(gymnasium.make("CarRacing-v3"), recorded_drive),
        "observation": lambda recorded_drive: seconds_a_step(make_car_racing(), recorded_drive),
        "gymnasium_picture": lambda recorded_drive: seconds_a_step(make_reference_environment(BOX), recorded_drive),
        "picture": lambda recorded_drive: seconds_a_step(make_car_racing(preprocessing=BOX.name), recorded_drive),
        "fitness_step_alone": lambda recorded_drive: seconds_a_step(
            task.make_environment(assignment), recorded_drive, make_random_policy(bundle).act
        ),
    }
    notes = []
    if find_spec("torch"):
        cases["torch_fitness_step"] = lambda recorded_drive: seconds_a_step(
            make_reference_environment(BOX), recorded_drive, make_torch_controller(bundle)
        )
    else:
        notes.append("ratio_fitness_step needs torch: pip install 'dreamfleet[train]'")
    if find_spec("envpool"):
        cases["envpool"] = envpool_seconds_a_step
    else:
        notes.append("ratio_envpool needs envpool: pip install envpool")
    return cases, notes


@dataclass(frozen=True)
class RecordedDrive:
    """A track's seed and the actions of a drive on it, each `(3,)`."""

    seed: int
    actions: list[NDArray[np.float32]]


def record_drive(seed: int) -> RecordedDrive:
    """Record the shipped controller on a track until the lap ends, or for 1000 steps."""
    policy = shipped_driver(find_bundle("tiny"))
    environment = make_car_racing(preprocessing=BOX.name)
    actions = [np.array(moment.action) for moment in run_episode(environment, policy, EpisodeConfig(seed, STEPS))]
    environment.close()
    return RecordedDrive(seed, actions)


def drive_lap(seed: int) -> RecordedDrive:
    """Drive a whole lap that touches every tile by steering towards a point ahead on the environment's centre line."""
    environment = make_car_racing(preprocessing=BOX.name, max_episode_steps=4 * STEPS)
    environment.reset(seed=seed)
    inner: Any = environment.unwrapped
    middle = np.array(inner.track)[:, 2:]
    actions: list[NDArray[np.float32]] = []
    info: dict[str, Any] = {}
    here = 0
    while not info.get("lap_finished"):
        hull = inner.car.hull
        position = np.array(hull.position)
        nearby = np.arange(here, here + 10) % len(middle)
        here = int(nearby[np.linalg.norm(middle[nearby] - position, axis=1).argmin()])
        (x, y), sine, cosine = middle[(here + 4) % len(middle)] - position, np.sin(hull.angle), np.cos(hull.angle)
        x, y = cosine * x + sine * y, cosine * y - sine * x
        speed = float(np.hypot(*hull.linearVelocity))
        steer = np.clip(2 * np.arctan2(x, y), -1, 1)
        target = 45 - 25 * abs(steer)
        actions.append(np.array([steer, 0.3 * (speed < target), 0.3 * (speed > target + 8)], np.float32))
        _, _, terminated, truncated, info = environment.step(actions[-1])
        if (terminated or truncated) and not info.get("lap_finished"):
            raise RuntimeError(f"no lap on track {seed}")  # a mistake in this function
    environment.close()
    return RecordedDrive(seed, actions)


def seconds_a_step(
    environment: gymnasium.Env[Any, Any], recorded_drive: RecordedDrive, policy: Policy | None = None
) -> float:
    """Seconds per step of one episode, reset included. The policy's time counts, its actions are not used."""
    started = perf_counter()
    observation, _ = environment.reset(seed=recorded_drive.seed)
    for action in recorded_drive.actions:
        if policy is not None:
            policy(observation)
        observation = environment.step(action)[0]
    seconds = (perf_counter() - started) / len(recorded_drive.actions)
    environment.close()
    return seconds


def seconds_a_step_side_by_side(bundle: Bundle, recorded_drives: Sequence[RecordedDrive]) -> float:
    """Seconds per step of episodes that are driven side by side, resets included, under a policy of random parameters.

    As in `seconds_a_step`, its time counts, and its actions are not used.
    """
    task, assignment = CarRacingTask(), Assignment.of(CarRacingTask.name, bundle)
    environments = [Repetition(task.make_environment(assignment), each) for each in recorded_drives]
    policies, parameters = make_random_policy(bundle).side_by_side(), random_parameters(bundle)
    started = perf_counter()
    scores = score_side_by_side(
        environments, policies, [parameters] * len(environments),
        [EpisodeConfig(each.seed, STEPS) for each in recorded_drives],
    )  # fmt: skip
    seconds = (perf_counter() - started) / sum(score.steps for score in scores)
    for environment in environments:
        environment.close()
    return seconds


class Repetition(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that takes a recorded drive's actions, whatever its agent chooses."""

    def __init__(self, environment: gymnasium.Env[Any, Any], recorded_drive: RecordedDrive) -> None:
        super().__init__(environment)
        self._actions = iter(recorded_drive.actions)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:  # noqa: ARG002 - of the interface
        """Take the next recorded action."""
        return self.env.step(next(self._actions))


def make_random_policy(bundle: Bundle) -> ModelPolicy:
    """A policy of the bundle with random parameters."""
    policy = ModelPolicy(bundle)
    policy.begin(random_parameters(bundle))
    return policy


def random_parameters(bundle: Bundle) -> NDArray[np.float32]:
    """Parameters `(size,)` of a random controller."""
    return np.random.default_rng(0).normal(0, 0.1, bundle.controller_shape.size).astype(np.float32)


def make_torch_controller(bundle: Bundle) -> Policy:
    """The same policy step in torch, one operation at a time, on a fixed picture."""
    from dreamfleet.worker.addons.bench.torch_steps import make_torch_step

    parameters = np.zeros((1, bundle.controller_shape.size), np.float32)
    step_once = make_torch_step(bundle, np.zeros((1, *bundle.manifest.picture), np.uint8), parameters)
    return lambda _picture: step_once()


def envpool_seconds_a_step(recorded_drive: RecordedDrive) -> float:
    """Seconds per step of one EnvPool CarRacing under the same actions; its pixels and tracks differ from ours."""
    import envpool

    environment = envpool.make("CarRacing-v3", env_type="gymnasium", num_envs=1, seed=recorded_drive.seed)
    started = perf_counter()
    environment.reset()
    for action in recorded_drive.actions:
        environment.step(action[None])
    return (perf_counter() - started) / len(recorded_drive.actions)


def check_exact(bundle: Bundle) -> Iterator[tuple[str, Mismatch | None]]:
    """Compare each kind of episode with gymnasium's; yield a description and the first difference, or `None`."""
    for seed in range(20):
        yield f"random, seed {seed}, 400 steps", compare(seed, 400, random_action)
    for seed in range(5):
        yield f"driven, seed {seed}, to the end", compare(seed, STEPS, make_driver(bundle))
    lap = drive_lap(3)
    yield (
        f"a completed lap of {len(lap.actions)} steps",
        compare(lap.seed, len(lap.actions) + 1, lambda step, _picture, _random: lap.actions[step]),
    )
    yield "off the field", compare(30, STEPS, lambda _step, _picture, _random: np.array([0.0, 1.0, 0.0], np.float32))
    for seed in range(2):
        yield f"domain_randomize, seed {seed}", compare(seed, 300, random_action, domain_randomize=True)
        yield f"discrete, seed {seed}", compare(seed, 300, random_discrete_action, continuous=False)


def random_discrete_action(_step: int, _picture: Any, random: np.random.Generator) -> int:
    """A random one of the five discrete actions, gas more often than the others."""
    return int(random.choice(5, p=[0.1, 0.2, 0.2, 0.4, 0.1]))


def make_driver(bundle: Bundle) -> ActionSource:
    """The shipped controller as a source of actions."""
    policy = shipped_driver(bundle)
    return lambda _step, picture, _random: policy.act(picture)


def shipped_driver(bundle: Bundle) -> ModelPolicy:
    """A bundle's policy under the controller shipped with it; `ControllerError` if it belongs to another bundle."""
    controller = Controller.load(pretrained_folder() / f"{bundle.manifest.name}.npz")
    if controller.bundle != bundle.sha256:
        raise ControllerError(f"the shipped controller {bundle.manifest.name} is not of {bundle.path}")
    policy = ModelPolicy(bundle)
    policy.begin(controller.parameters)
    return policy
