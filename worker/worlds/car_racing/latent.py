"""CarRacing as a world model sees it: the real environment for an agent that was trained in the dream."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.worker.worldmodel.observation import Observation, open_bundle
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState
from dreamfleet.worker.worlds.car_racing.environment import find_reference
from dreamfleet.worker.worlds.car_racing.native_check import make_car_racing
from dreamfleet.worker.worlds.car_racing.task import WORLD, CarRacingTask, make_reference_environment

Floats = NDArray[np.float32]


class CarRacingLatent(gymnasium.Env[Floats, Floats]):
    """Gymnasium's CarRacing with the observations and actions of `Dream`: latent `(latent,)`, actions `(3,)`.

    The latent is the encoder's mean; with `features` `zh` the MDN-RNN's hidden state follows it. Both equal what
    controllers see, to the bit. Rewards, ends and `info` are gymnasium's. With `native`, and without Box2D or pygame,
    our environment drives where that is exact, which is faster and changes nothing else.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": WORLD.frames_per_second}  # noqa: RUF012

    def __init__(
        self, bundle: Bundle | str = "tiny", features: str = "z", render_mode: str | None = None, *,
        native: bool = False,
    ) -> None:  # fmt: skip
        found = open_bundle(bundle)
        pictures = CarRacingTask().preprocessing(found)
        self._environment = (
            make_car_racing(preprocessing=pictures.name, render_mode=render_mode)
            if native or not find_reference()
            else make_reference_environment(pictures, render_mode)
        )
        self._mind, self._observation = RecurrentState(found), Observation(found, features)
        self.render_mode = render_mode
        self.observation_space, self.action_space = self._observation.space, self._environment.action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Begin on the track of a seed; without one, on the next random track."""
        super().reset(seed=seed, options=options)
        picture, info = self._environment.reset(seed=seed, options=options)
        self._mind.begin()
        return self._observe(picture), info

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Drive one step with `action` `(3,)`; `ValueError` if it is not finite."""
        done = np.asarray(action, dtype=np.float32).reshape(3)
        if not np.isfinite(done).all():
            raise ValueError("an action must be three finite numbers")
        picture, reward, terminated, truncated, info = self._environment.step(done)
        self._mind.advance(done[None])
        self._mind.reward(float(reward))
        return self._observe(picture), float(reward), terminated, truncated, info

    def render(self) -> Any:
        """Gymnasium's picture."""
        return self._environment.render()

    def close(self) -> None:
        """Close gymnasium's environment."""
        self._environment.close()

    def _observe(self, picture: NDArray[np.uint8]) -> Floats:
        self._mind.see(picture)
        seen: Floats = self._observation.observe(self._mind.latent, self._mind.state)[0]
        return seen
