"""Measuring the environment against gymnasium's own, and proving the two equal."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from time import perf_counter
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from common.bundle import Bundle, pretrained
from common.controller import Controller
from common.seeds import VALIDATION
from worker.render.check import Actions, Difference, compare, leap, make_car_racing
from worker.tasks.car_racing import CarRacingPolicy, PictureObservation

STEPS = 1000
Act = Callable[[int, Any], Any]


def bench_env(bundle: Bundle, rounds: int) -> dict[str, Any]:
    """Whole episodes, reset and opening zoom included, of every kind in turn; ratios of medians of time a step."""
    cases: dict[str, Callable[[int], float]] = {
        "gymnasium": lambda seed: seconds_a_step(gymnasium.make("CarRacing-v3"), weave, seed),
        "observation": lambda seed: seconds_a_step(make_car_racing(), weave, seed),
        "gymnasium_picture": lambda seed: seconds_a_step(
            PictureObservation(gymnasium.make("CarRacing-v3")), weave, seed
        ),
        "picture": lambda seed: seconds_a_step(make_car_racing(picture_only=True), weave, seed),
        "fitness_step": lambda seed: seconds_a_step(make_car_racing(picture_only=True), policy_of(bundle), seed),
    }
    notes = []
    if find_spec("torch"):
        cases["torch_fitness_step"] = lambda seed: seconds_a_step(
            PictureObservation(gymnasium.make("CarRacing-v3")), torch_policy_of(bundle), seed
        )
    else:
        notes.append("ratio_fitness_step needs torch: pip install 'dreamfleet[train]'")
    if find_spec("envpool"):
        cases["envpool"] = envpool_seconds_a_step
    else:
        notes.append("ratio_envpool needs envpool: pip install envpool")
    times: dict[str, list[float]] = {name: [] for name in cases}
    for round_number in range(rounds):
        for name, measure in cases.items():
            times[name].append(measure(VALIDATION.start + round_number))
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


def seconds_a_step(environment: gymnasium.Env[Any, Any], act: Act, seed: int) -> float:
    """One episode from its reset on; it goes on after its end, so that all are equally long."""
    started = perf_counter()
    observation, _ = environment.reset(seed=seed)
    for step in range(STEPS):
        observation, _, terminated, truncated, _ = environment.step(act(step, observation))
        if (terminated or truncated) and step < STEPS - 1:
            observation, _ = environment.reset(seed=seed)
    seconds = (perf_counter() - started) / STEPS
    environment.close()
    return seconds


def weave(step: int, _observation: Any) -> NDArray[np.float32]:
    """Gentle bends with some gas: the car moves and leaves the road at times."""
    return np.array([0.15 * np.sin(step / 11), 0.25, 0.0], dtype=np.float32)


def policy_of(bundle: Bundle) -> Act:
    """A controller at work, its parameters at random."""
    policy = CarRacingPolicy(bundle)
    policy.begin(np.random.default_rng(0).normal(0, 0.1, bundle.controller_shape.size).astype(np.float32))
    return lambda _step, observation: policy.act(observation)


def torch_policy_of(bundle: Bundle) -> Act:
    """The same work in torch, one operation at a time; the action is thrown away for a gentle one."""
    from worker.worldmodel.eager import make_torch_step

    parameters = np.zeros((1, bundle.controller_shape.size), np.float32)
    step_once = make_torch_step(bundle, np.zeros((1, *bundle.manifest.picture), np.uint8), parameters)

    def act(step: int, observation: Any) -> Any:
        step_once()
        return weave(step, observation)

    return act


def envpool_seconds_a_step(seed: int) -> float:
    """EnvPool's CarRacing, one environment; not the same pixels."""
    import envpool

    environment = envpool.make("CarRacing-v3", env_type="gymnasium", num_envs=1, seed=seed)
    started = perf_counter()
    environment.reset()
    for step in range(STEPS):
        environment.step(weave(step, None)[None])
    return (perf_counter() - started) / STEPS


def prove_exact(bundle: Bundle) -> Iterator[tuple[str, Difference | None]]:
    """Every kind of episode beside gymnasium's own; yields what was driven and the first difference."""
    for seed in range(20):
        yield f"random, seed {seed}, 400 steps", compare(seed, 400, leap)
    for seed in range(5):
        yield f"driven, seed {seed}, to the end", compare(seed, STEPS, driver(bundle))
    yield "off the field", compare(30, STEPS, lambda _step, _picture, _random: np.array([0.0, 1.0, 0.0], np.float32))
    for seed in range(2):
        yield f"domain_randomize, seed {seed}", compare(seed, 300, leap, domain_randomize=True)
        yield f"discrete, seed {seed}", compare(seed, 300, discrete, continuous=False)


def discrete(_step: int, _picture: Any, random: np.random.Generator) -> int:
    """Any of the five discrete actions, gas more often."""
    return int(random.choice(5, p=[0.1, 0.2, 0.2, 0.4, 0.1]))


def driver(bundle: Bundle) -> Actions:
    """The shipped controller, which drives."""
    policy = CarRacingPolicy(bundle)
    policy.begin(Controller.load(pretrained() / f"{bundle.manifest.name}.npz").parameters)
    return lambda _step, picture, _random: policy.act(picture)
