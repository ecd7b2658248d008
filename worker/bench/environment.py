"""Measuring the environment against gymnasium's own, and proving the two equal."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from time import perf_counter
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.controller import Controller
from dreamfleet.common.errors import ControllerError
from dreamfleet.common.seeds import VALIDATION
from dreamfleet.common.store import find_bundle, pretrained
from dreamfleet.worker.car_racing.check import Actions, Difference, compare, leap, make_car_racing
from dreamfleet.worker.car_racing.preprocessing import BOX
from dreamfleet.worker.car_racing.task import CarRacing, CarRacingPolicy, PictureObservation
from dreamfleet.worker.scoring.episode import Course, play
from dreamfleet.worker.tasks.api import Assignment

STEPS = 1000
Policy = Callable[[NDArray[np.uint8]], Any]


def bench_env(bundle: Bundle, rounds: int) -> dict[str, Any]:
    """Whole driven episodes, reset and opening zoom included, of every kind in turn; ratios of medians of time a step.

    Every kind drives the same actions, which the shipped controller chose on that track beforehand.
    """
    cases, notes = _cases(bundle)
    times: dict[str, list[float]] = {name: [] for name in cases}
    for round_number in range(rounds):
        plan = recorded_plan(VALIDATION.start + round_number)
        for name, measure in cases.items():
            times[name].append(measure(plan))
    seconds = {name: statistics.median(values) for name, values in times.items()}

    def ratio(slow: str, fast: str) -> float | None:
        return round(seconds[slow] / seconds[fast], 2) if slow in seconds else None

    return {
        "exact": all(compare(seed, 100, leap) is None for seed in range(2)),
        "ratio_observation": ratio("gymnasium", "observation"),
        "ratio_picture": ratio("gymnasium_picture", "picture"),
        "ratio_envpool": ratio("envpool", "observation"),
        "ratio_fitness_step": ratio("torch_fitness_step", "fitness_step"),
        "microseconds_a_step": {name: round(value * 1e6, 1) for name, value in seconds.items()},
        "episodes": rounds,
        **({"notes": notes} if notes else {}),
    }


def _cases(bundle: Bundle) -> tuple[dict[str, Callable[[Plan], float]], list[str]]:
    """What is measured, by name, and what is not for want of a package."""
    task, assignment = CarRacing(), Assignment.of(CarRacing.name, bundle)
    cases: dict[str, Callable[[Plan], float]] = {
        "gymnasium": lambda plan: seconds_a_step(gymnasium.make("CarRacing-v3"), plan),
        "observation": lambda plan: seconds_a_step(make_car_racing(), plan),
        "gymnasium_picture": lambda plan: seconds_a_step(PictureObservation(gymnasium.make("CarRacing-v3"), BOX), plan),
        "picture": lambda plan: seconds_a_step(make_car_racing(preprocessing=BOX.name), plan),
        "fitness_step": lambda plan: seconds_a_step(task.make_environment(assignment), plan, policy_of(bundle)),
    }
    notes = []
    if find_spec("torch"):
        cases["torch_fitness_step"] = lambda plan: seconds_a_step(
            task.make_judge(assignment), plan, torch_policy_of(bundle)
        )
    else:
        notes.append("ratio_fitness_step needs torch: pip install 'dreamfleet[train]'")
    if find_spec("envpool"):
        cases["envpool"] = envpool_seconds_a_step
    else:
        notes.append("ratio_envpool needs envpool: pip install envpool")
    return cases, notes


@dataclass(frozen=True)
class Plan:
    """A track and what was done on it."""

    seed: int
    actions: list[NDArray[np.float32]]


def recorded_plan(seed: int) -> Plan:
    """What the shipped controller does on a track; it ends with the lap, or after 1000 steps."""
    policy, controller = shipped_driver(find_bundle("tiny"))
    policy.begin(controller.parameters)
    environment = make_car_racing(preprocessing=BOX.name)
    actions = [np.array(moment.action) for moment in play(environment, policy, Course(seed, STEPS))]
    environment.close()
    return Plan(seed, actions)


def completed_lap(seed: int) -> Plan:
    """A drive that touches every tile: towards a point ahead on the middle of the road, which the environment knows."""
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
        x, y = hull.GetLocalVector(middle[(here + 4) % len(middle)] - position)
        speed = float(np.hypot(*hull.linearVelocity))
        steer = np.clip(2 * np.arctan2(x, y), -1, 1)
        target = 45 - 25 * abs(steer)
        actions.append(np.array([steer, 0.3 * (speed < target), 0.3 * (speed > target + 8)], np.float32))
        _, _, terminated, truncated, info = environment.step(actions[-1])
        if (terminated or truncated) and not info.get("lap_finished"):
            raise RuntimeError(f"no lap on track {seed}")  # a mistake in this function
    environment.close()
    return Plan(seed, actions)


def seconds_a_step(environment: gymnasium.Env[Any, Any], plan: Plan, policy: Policy | None = None) -> float:
    """One episode from its reset on. What the policy answers costs its time and is not driven."""
    started = perf_counter()
    observation, _ = environment.reset(seed=plan.seed)
    for action in plan.actions:
        if policy is not None:
            policy(observation)
        observation = environment.step(action)[0]
    seconds = (perf_counter() - started) / len(plan.actions)
    environment.close()
    return seconds


def policy_of(bundle: Bundle) -> Policy:
    """A controller at work, its parameters at random."""
    policy = CarRacingPolicy(bundle)
    policy.begin(np.random.default_rng(0).normal(0, 0.1, bundle.controller_shape.size).astype(np.float32))
    return policy.act


def torch_policy_of(bundle: Bundle) -> Policy:
    """The same work in torch, one operation at a time, on a picture of its own."""
    from dreamfleet.worker.bench.eager import make_torch_step

    parameters = np.zeros((1, bundle.controller_shape.size), np.float32)
    step_once = make_torch_step(bundle, np.zeros((1, *bundle.manifest.picture), np.uint8), parameters)
    return lambda _picture: step_once()


def envpool_seconds_a_step(plan: Plan) -> float:
    """EnvPool's CarRacing, one environment; not the same pixels, and the same actions on tracks of its own."""
    import envpool

    environment = envpool.make("CarRacing-v3", env_type="gymnasium", num_envs=1, seed=plan.seed)
    started = perf_counter()
    environment.reset()
    for action in plan.actions:
        environment.step(action[None])
    return (perf_counter() - started) / len(plan.actions)


def prove_exact(bundle: Bundle) -> Iterator[tuple[str, Difference | None]]:
    """Every kind of episode beside gymnasium's own; yields what was driven and the first difference."""
    for seed in range(20):
        yield f"random, seed {seed}, 400 steps", compare(seed, 400, leap)
    for seed in range(5):
        yield f"driven, seed {seed}, to the end", compare(seed, STEPS, driver(bundle))
    lap = completed_lap(3)
    yield (
        f"a completed lap of {len(lap.actions)} steps",
        compare(lap.seed, len(lap.actions) + 1, lambda step, _picture, _random: lap.actions[step]),
    )
    yield "off the field", compare(30, STEPS, lambda _step, _picture, _random: np.array([0.0, 1.0, 0.0], np.float32))
    for seed in range(2):
        yield f"domain_randomize, seed {seed}", compare(seed, 300, leap, domain_randomize=True)
        yield f"discrete, seed {seed}", compare(seed, 300, discrete, continuous=False)


def discrete(_step: int, _picture: Any, random: np.random.Generator) -> int:
    """Any of the five discrete actions, gas more often."""
    return int(random.choice(5, p=[0.1, 0.2, 0.2, 0.4, 0.1]))


def driver(bundle: Bundle) -> Actions:
    """The shipped controller, which drives."""
    policy, controller = shipped_driver(bundle)
    policy.begin(controller.parameters)
    return lambda _step, picture, _random: policy.act(picture)


def shipped_driver(bundle: Bundle) -> tuple[CarRacingPolicy, Controller]:
    """A bundle's policy and the controller that ships with it."""
    controller = Controller.load(pretrained() / f"{bundle.manifest.name}.npz")
    if controller.bundle != bundle.sha256:
        raise ControllerError(f"the shipped controller {bundle.manifest.name} is not of {bundle.path}")
    return CarRacingPolicy(bundle), controller
