"""CarRacing-v3, seen through the world model's encoder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE, Mirror
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.car_racing_variants import FACTS
from dreamfleet.worker.tasks.api import Assignment, DreamReward, Driver, Policy, Task, World
from dreamfleet.worker.tasks.model_free_policies import DriverPolicy
from dreamfleet.worker.tasks.recordable import Preprocessing
from dreamfleet.worker.tasks.registry import preprocessing_for
from dreamfleet.worker.worldmodel.policy import ModelPolicy
from dreamfleet.worker.worlds.car_racing.drivers import DRIVERS, PushedDriver, UniformDriver
from dreamfleet.worker.worlds.car_racing.environment import find_reference
from dreamfleet.worker.worlds.car_racing.native_check import (
    CHECK_INTERVAL,
    judge_name,
    make_car_racing,
    native_is_exact,
)
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX, PREPROCESSINGS, find_preprocessing
from dreamfleet.worker.worlds.car_racing.random_network import RandomNetworkPolicy
from dreamfleet.worker.worlds.car_racing.true_state import read_true_state

ENVIRONMENT = "CarRacing-v3"
SPARED = ("pygame-ce", "box2d", "box2d-py")  # packages without which the native core drives and judges alone
WORLD = World(
    actions=STEERING_GAS_BRAKE,
    packages=FACTS.packages,
    idle_cost=0.1,
    horizon=FACTS.horizon,
    frames_per_second=FACTS.frames_per_second,
    action_names=FACTS.action_names,
    dream_reward=DreamReward(gain=FACTS.reward.gain, cost=FACTS.reward.cost),
    off_course="off_road",  # `OffRoadInfo` says so
    threshold=gymnasium.spec(ENVIRONMENT).reward_threshold,
    finish="lap_finished",  # gymnasium says so as an episode ends; one that runs out of time says nothing
    judge="gymnasium",
    score_word=FACTS.score_word,
    marks=FACTS.marks,
    mirror=Mirror(order=(0, 1, 2), signs=(-1, 1, 1)),  # steering
    lost_after=40,  # as LOSS_STEPS of worker/training/data/drive_steps.py
    opening=50,  # the camera zooms in
    preset="tiny",
)

POLICIES: dict[str, Callable[[np.random.Generator], Policy]] = {
    "uniform": lambda random: DriverPolicy(UniformDriver(random)),
    "pushed": lambda random: DriverPolicy(PushedDriver(random)),
    "network": RandomNetworkPolicy,
}


class CarRacingTask(Task):
    """The task `car-racing`."""

    name = "car-racing"
    batch_size: ClassVar[int] = 4  # with eight bits a step takes a seventh less time than alone; eight save hardly more
    world = WORLD
    drivers: Mapping[str, Callable[[np.random.Generator], Driver]] = DRIVERS
    policies = POLICIES
    preprocessings: Mapping[str, Preprocessing] = PREPROCESSINGS
    agent_world, agent_options, agent_pictures = WORLD, "", PREPROCESSINGS

    def world_of(self, assignment: Assignment) -> World:
        """The world with the actions and costs of the run's variant, and what judges here."""
        variant = assignment.world_model.variant
        packages = WORLD.packages if find_reference() else tuple(each for each in WORLD.packages if each not in SPARED)
        return replace(
            WORLD, packages=packages, actions=variant.controls, version=variant.version, time_cost=variant.time_cost,
            off_course_cost=variant.offroad_cost, judge=judge_name(),
        )  # fmt: skip

    def make_environment(self, assignment: Assignment) -> gymnasium.Env[Any, Any]:
        """The environment with the native picture, if that is exact, in the bundle's preprocessing."""
        return _with_off_road_info(self.make_recorded(self.preprocessing(assignment.world_model).name), assignment)

    def make_recorded(self, preprocessing: str) -> gymnasium.Env[Any, Any]:
        """The same, in the preprocessing of this name."""
        return make_car_racing(preprocessing=preprocessing)

    def make_evaluation_environment(
        self, assignment: Assignment, render_mode: str | None = None
    ) -> gymnasium.Env[Any, Any]:
        """Gymnasium's world in the bundle's preprocessing; `make_judging_environment` says who draws."""
        return _with_off_road_info(
            make_judging_environment(self.preprocessing(assignment.world_model), render_mode), assignment
        )

    def make_policy(self, assignment: Assignment) -> ModelPolicy:
        """The policy of a bundle: encoder, controller and MDN-RNN; `BundleError` for other pictures."""
        self.preprocessing(assignment.world_model)
        return ModelPolicy(assignment.world_model)

    def find_standalone_script(self, assignment: Assignment) -> Path:  # noqa: ARG002 - one for all
        """The script that drives by a graph."""
        return Path(__file__).with_name("standalone_drive.py")

    def begin_anywhere(self, environment: gymnasium.Env[Any, Any], random: np.random.Generator) -> Any:
        """Move the car to a random tile, a little turned and shifted, and skip the opening zoom."""
        inner: Any = environment.unwrapped
        _, beta, x, y = inner.track[random.integers(len(inner.track))]
        shift, turn = random.normal(0, 2.0), random.normal(0, 0.25)
        inner.place(beta + turn, x + shift * np.cos(beta), y + shift * np.sin(beta))
        inner.t = 1.0  # the camera zooms in during the first second
        return environment.step(np.zeros(3, dtype=np.float32))[0]

    def truth(self, environment: gymnasium.Env[Any, Any]) -> dict[str, float]:
        """The simulator's state of car and road; `true_state` documents units and signs."""
        return read_true_state(environment.unwrapped)

    def make_agent_environment(self, preprocessing: str, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """The environment that a trained agent's scores come from, observing the pictures of this name."""
        return make_judging_environment(find_preprocessing(preprocessing), render_mode)

    def make_scene(self, steps: int) -> CarRacingScene:
        """The track on a screen, for a person who drives."""
        return CarRacingScene(steps)

    def preprocessing(self, bundle: Bundle) -> Preprocessing:
        """The preprocessing of the bundle's pictures; `BundleError` if this task has no such pictures."""
        return preprocessing_for(bundle, self)


class CarRacingScene:
    """CarRacing, drawn by gymnasium at its full size of 1000x800; without Box2D the observation with larger pixels."""

    name, scale = "CarRacing", 1.0

    def __init__(self, steps: int) -> None:
        self.environment = make_car_racing(preprocessing=BOX.name, render_mode="rgb_array", max_episode_steps=steps)

    def surface(self) -> Any:
        """The picture as a surface of pygame; gymnasium's own one, of which `render` returns a smaller copy."""
        import pygame

        picture: Any = self.environment.render()
        inner: Any = self.environment.unwrapped
        drawn = getattr(inner, "shadow", inner)  # gymnasium's environment, which may be all that there is
        return pygame.surfarray.make_surface(picture.transpose(1, 0, 2)) if drawn is None else drawn.surf


def make_judging_environment(preprocessing: Preprocessing, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
    """Make the environment that reported scores come from, observing the pictures of a preprocessing.

    It is gymnasium's unmodified one, unless the native one is exact here and nobody watches. Gymnasium's then drives
    along and draws the first and every 50th picture too, and an episode ends with an error at the first difference.
    Where Box2D or pygame cannot be imported, the native one judges alone, and reports say so.
    """
    if not (render_mode and find_reference()) and native_is_exact():
        return make_car_racing(preprocessing=preprocessing.name, render_mode=render_mode, checked=CHECK_INTERVAL)
    return make_reference_environment(preprocessing, render_mode)


def make_reference_environment(preprocessing: Preprocessing, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
    """Make gymnasium's unmodified environment, observing the pictures of a preprocessing."""
    made = gymnasium.make(ENVIRONMENT, render_mode=render_mode)
    return TransformObservation(made, preprocessing.picture, spaces.Box(0, 255, preprocessing.shape, np.uint8))


class OffRoadInfo(gymnasium.Wrapper[Any, Any, Any, Any]):
    """CarRacing whose `info["off_road"]` is true while any wheel touches no road tile."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """The environment's step with `off_road` added to `info`."""
        *given, info = self.env.step(action)
        inner: Any = self.env.unwrapped
        info[WORLD.off_course] = not all(wheel.tiles for wheel in inner.car.wheels)
        return (*given, info)


def _with_off_road_info(environment: gymnasium.Env[Any, Any], assignment: Assignment) -> gymnasium.Env[Any, Any]:
    """Wrap the environment in `OffRoadInfo` if candidates pay for steps off the road."""
    return OffRoadInfo(environment) if assignment.world_model.variant.offroad_cost else environment
