"""A fresh drive in CarRacing, and what the encoder makes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.controller import Controller
from dreamfleet.worker.car_racing.drivers import OrnsteinUhlenbeckDriver
from dreamfleet.worker.car_racing.task import CarRacing
from dreamfleet.worker.worldmodel.inference import Encoder

Floats = NDArray[np.float32]
Pictures = NDArray[np.uint8]
ZOOM = 50  # steps: CarRacing's camera comes down in the first second


@dataclass(frozen=True)
class DriveConfig:
    """Which track, and how far."""

    seed: int = 20_000  # a validation track
    steps: int = 300


@dataclass(frozen=True)
class Drive:
    """T steps: `picture` (T, side, side, 3) and its `mu`, `logvar` (T, latent); then `action` (T, 3), `reward` (T,)."""

    picture: Pictures
    mu: Floats
    logvar: Floats
    action: Floats
    reward: NDArray[np.float64]
    driver: str

    def __len__(self) -> int:
        return len(self.action)

    @property
    def nats(self) -> Floats:
        """What each latent carries `(latent,)`: its divergence from the standard normal, on average."""
        nats: Floats = self._divergence.mean(axis=0)
        return nats

    @property
    def most_active(self) -> NDArray[np.int64]:
        """The latents' numbers `(latent,)`, those that carry most first."""
        return np.argsort(-self.nats, kind="stable")

    @property
    def richest(self) -> int:
        """The step whose picture says most; of a drive that is long enough, one after the opening's zoom."""
        start = ZOOM if len(self) > ZOOM else 0
        return start + int(self._divergence[start:].sum(axis=1).argmax())

    @property
    def _divergence(self) -> Floats:
        """In nats `(T, latent)`."""
        told: Floats = 0.5 * (self.mu**2 + np.exp(self.logvar) - self.logvar - 1)
        return told


def drive(bundle: Bundle, controller: Controller | None, config: DriveConfig) -> Drive:
    """Drive one episode: the controller, or without one the random driver that drifts around slight gas."""
    policy = CarRacing().make_policy(bundle)
    if controller is not None:
        policy.begin(controller.parameters)
        return _drive(bundle, policy.act, policy.reward, "the run's controller", config)
    driver = OrnsteinUhlenbeckDriver(np.random.default_rng(config.seed))
    return _drive(bundle, lambda _picture: driver.act(), lambda _reward: None, "a random driver", config)


def _drive(
    bundle: Bundle, act: Callable[[Pictures], Floats], tell: Callable[[float], None], driver: str, config: DriveConfig
) -> Drive:
    environment = CarRacing().make_environment(bundle)
    observation, _ = environment.reset(seed=config.seed)
    pictures: list[Pictures] = []
    actions: list[Floats] = []
    rewards: list[float] = []
    ended = False
    while len(actions) < config.steps and not ended:
        action = act(observation)
        pictures.append(observation)
        observation, reward, terminated, truncated, _ = environment.step(action)
        tell(float(reward))
        actions.append(action)
        rewards.append(float(reward))
        ended = terminated or truncated
    environment.close()
    seen = np.stack(pictures)
    mu, logvar = Encoder(bundle).encode(seen)
    return Drive(seen, mu, logvar, np.stack(actions), np.array(rewards), driver)
