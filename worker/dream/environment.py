"""The dream as gymnasium environments, single and vectorised. They observe latents; the decoder renders them.

For CarRacing, the environment of `car_racing.latent` has the same observations in reality. Pages: python.md.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.worker.dream.noise import EpisodeNoise, stack_draws
from dreamfleet.worker.dream.world import DreamWorld
from dreamfleet.worker.worldmodel.inference import Decoder
from dreamfleet.worker.worldmodel.observation import Observation, open_bundle

Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]


def action_space(actions: Continuous) -> Any:
    """The gymnasium space of a world's actions: a box, or the number of its choice or of each of them."""
    if sizes := actions.sizes:
        return spaces.Discrete(sizes[0]) if len(sizes) == 1 else spaces.MultiDiscrete(list(sizes))
    return spaces.Box(np.array(actions.low, np.float32), np.array(actions.high, np.float32))


def to_rows(actions: Continuous, given: Any, count: int) -> Floats:
    """The actions `(count, A)` of that many dreams, each given as such a row, or as the numbers of its choices.

    `ValueError` for anything else.

    >>> from dreamfleet.common.artifacts.actions import one_hot
    >>> to_rows(one_hot(3), [2, 0], count=2)
    array([[0., 0., 1.],
           [1., 0., 0.]], dtype=float32)
    """
    found, sizes = np.asarray(given), actions.sizes
    if sizes and found.size == count * len(sizes) and np.issubdtype(found.dtype, np.integer):
        numbers = found.reshape(count, len(sizes))
        if not ((numbers >= 0) & (numbers < sizes)).all():
            most = " ".join(str(size - 1) for size in sizes)
            raise ValueError(f"the numbers of an action must be from 0 to {most}")
        found = actions.from_numbers(numbers)
    rows = found.astype(np.float32)
    if rows.size != count * actions.actions or not np.isfinite(rows).all():
        raise ValueError(f"an action must be {actions.actions} finite numbers")
    return rows.reshape(count, actions.actions)


class Dream(gymnasium.Env[Floats, Any]):
    """One dream. It observes the latent `(latent,)` and takes the actions of the bundle's world.

    An action is `(A,)`; where the world has choices, it may be the number of one. With `features="zh"` the MDN-RNN's
    hidden state follows the latent, `(latent + hidden,)`. An episode is a pure function of its seed and actions. It
    terminates by the bundle's rule, or by `end`: `drawn`, or a threshold as a text. It is truncated after `horizon`
    steps, by default the world's. `recorded` is the share of episodes that start at recorded states.

    >>> dream = Dream("tiny", horizon=50)
    >>> latent, info = dream.reset(seed=1)
    >>> latent.shape, dream.action_space.shape
    ((32,), (3,))
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - gymnasium's name

    def __init__(
        self, bundle: Bundle | str = "tiny", temperature: float = 1.0, horizon: int | None = None,
        render_mode: str | None = None, recorded: float = 0.0, features: str = "z", end: str = "",
    ) -> None:  # fmt: skip
        opened = open_bundle(bundle)
        self._world = DreamWorld(opened, temperature, recorded=recorded, end=end)
        self.metadata = {**self.metadata, "render_fps": self._world.frames_per_second}
        self._horizon = horizon or opened.manifest.world.horizon
        self.render_mode = render_mode
        self._decoder = Decoder(opened) if render_mode else None
        self._observation = Observation(opened, features)
        self.observation_space = self._observation.space
        self.action_space = action_space(self._world.actions)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Start an episode; without a seed the next random one. `info["memory"]` is the model's memory at the start."""
        super().reset(seed=seed, options=options)
        dream = int(self.np_random.integers(2**31)) if seed is None else seed
        self._noise = EpisodeNoise(dream, self._world.chance, self._world.bars)
        begun = self._noise.begin(self._world.start_states)
        self._latent = begun.latent[None]
        self._state = self._world.begin(1, begun.memory)
        self._steps = 0
        return self._observe(), {"memory": begun.memory.copy()}

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Dream one step with `action`, `(A,)` or the number of a choice; `ValueError` for another."""
        given = to_rows(self._world.actions, action, 1)
        moment = self._world.imagine(self._latent, given, self._state, self._noise.next())
        self._latent, self._state = moment.latent, moment.state
        self._steps += 1
        truncated = self._steps >= self._horizon
        return self._observe(), float(moment.reward[0]), bool(moment.done[0]), truncated, {}

    def render(self) -> NDArray[np.uint8] | None:
        """The decoded latent, a picture `(side, side, 3)`."""
        return None if self._decoder is None else self._decoder.decode(self._latent)[0]

    def _observe(self) -> Floats:
        seen: Floats = self._observation.observe(self._latent, self._state)[0]
        return seen


class VectorDream(gymnasium.vector.VectorEnv[Floats, Any, Any]):
    """Many dreams in one batch. A finished one restarts at the next step, as in gymnasium's vector environments.

    After `reset(seed=s)` dream `i` is the single environment's of seed `s + i`.
    """

    metadata: dict[str, Any] = {"autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP}  # noqa: RUF012 - gymnasium's name

    def __init__(
        self, num_envs: int, bundle: Bundle | str = "tiny", temperature: float = 1.0, horizon: int | None = None,
        render_mode: str | None = None, recorded: float = 0.0, features: str = "z", end: str = "",
    ) -> None:  # fmt: skip
        one = Dream(bundle, temperature, horizon, render_mode, recorded, features, end)
        self._world, self._horizon = one._world, one._horizon
        self._decoder, self._observation = one._decoder, one._observation
        self.metadata = {**self.metadata, "render_fps": self._world.frames_per_second}
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space, self.single_action_space = one.observation_space, one.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Start all dreams; `seed` is the first one's, or a list of all. `info["memory"]` `(num_envs, memory)`."""
        super().reset(seed=seed if isinstance(seed, int) else None, options=options)
        seeds: list[int | None] = list(seed) if isinstance(seed, (list, tuple)) else [None] * self.num_envs
        if isinstance(seed, int):
            seeds = [seed + index for index in range(self.num_envs)]
        self._latent = np.zeros((self.num_envs, self._world.chance.latent), dtype=np.float32)
        self._state = self._world.begin(self.num_envs)
        self._memory = self._state[:, : self._world.memory_size].copy()
        self._noise = [EpisodeNoise(0, self._world.chance)] * self.num_envs
        self._steps = np.zeros(self.num_envs, dtype=np.int64)
        self._over = np.zeros(self.num_envs, dtype=bool)
        for index, each in enumerate(seeds):
            self._reset_one(index, each)
        return self._observe(), self._start_info(np.ones(self.num_envs, dtype=bool))

    def step(self, actions: Any) -> tuple[Floats, NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Dream one step with `actions`, `(num_envs, A)` or numbers of choices `(num_envs,)`."""
        given = to_rows(self._world.actions, actions, self.num_envs)
        draw = stack_draws([noise.next() for noise in self._noise], axis=0).map(np.concatenate)
        moment = self._world.imagine(self._latent, given, self._state, draw)
        self._latent, self._state = moment.latent.copy(), moment.state.copy()
        self._steps += 1
        reward, done, truncated = moment.reward.copy(), moment.done.copy(), self._steps >= self._horizon
        begun = self._over
        for index in np.flatnonzero(begun):
            self._reset_one(int(index), None)
            reward[index], done[index], truncated[index] = 0.0, False, False
        self._over = done | truncated
        return self._observe(), reward, done, truncated, self._start_info(begun) if begun.any() else {}

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """The decoded latents, one picture `(side, side, 3)` a dream."""
        return None if self._decoder is None else tuple(self._decoder.decode(self._latent))

    def _observe(self) -> Floats:
        return self._observation.observe(self._latent, self._state)

    def _start_info(self, begun: Flags) -> dict[str, Any]:
        """The `info` of dreams that have just started, in the form of gymnasium's vector environments."""
        return {"memory": self._memory.copy(), "_memory": begun}

    def _reset_one(self, index: int, seed: int | None) -> None:
        dream = int(self.np_random.integers(2**31)) if seed is None else seed
        self._noise[index] = EpisodeNoise(dream, self._world.chance, self._world.bars)
        self._latent[index], self._memory[index] = self._noise[index].begin(self._world.start_states)
        self._state[index] = self._world.begin(1, self._memory[index])
        self._steps[index] = 0
