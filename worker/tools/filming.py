"""A drive as frames: the world, what the model sees of it, what it makes of that, and what it dreams."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import Bundle
from dreamfleet.worker.dream.daydream import Daydream, DaydreamConfig, can_dream
from dreamfleet.worker.tasks.api import World
from dreamfleet.worker.tools.canvas import AWAKE, DREAMING, Canvas, Dreamt, Frame, Layout, Mind, Moment, plain_layout
from dreamfleet.worker.worldmodel.inference import Decoder


class Thoughts:
    """What a world model sees, decodes and dreams while its controller drives."""

    def __init__(self, bundle: Bundle, policy: Any, parameters: NDArray[np.float32], dreaming: DaydreamConfig) -> None:
        self._policy, self._decoder = policy, Decoder(bundle)
        self._daydream = Daydream(bundle, parameters, dreaming) if can_dream(bundle) else None
        self.layout = DREAMING if self._daydream else AWAKE

    def follow(self, step: int, state: Any) -> None:
        """Dream this step too; `state` is the policy's from before it acted."""
        if self._daydream is not None:
            self._imagined = self._daydream.follow(step, self._policy.latent, state)

    def mind(self, seen: NDArray[np.uint8]) -> Mind:
        """The pictures at the step that was followed last."""
        decoded, dreamt = self._decoder.decode(self._policy.latent)[0], None
        if self._daydream is not None:
            dreamt = Dreamt(self._decoder.decode(self._imagined)[0], self._daydream.since)
        return Mind(seen, decoded, dreamt)


class Filmed:
    """A policy whose steps become frames, as the world looks before the action."""

    def __init__(self, policy: Any, painter: Painter, thoughts: Thoughts | None) -> None:
        self._policy, self._painter, self._thoughts = policy, painter, thoughts
        self._step, self._score = 0, 0.0

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Begin an episode."""
        self._policy.begin(parameters)

    def act(self, observation: Any) -> Any:
        """The policy's action, and a frame of it if one is due."""
        state = getattr(self._policy, "state", None)
        action = self._policy.act(observation)
        if self._thoughts is not None:
            self._thoughts.follow(self._step, state)
        if self._step % self._painter.every == 0:
            mind, layout = None, None
            if self._thoughts is not None:
                mind, layout = self._thoughts.mind(observation), self._thoughts.layout
            self._painter.add(action, self._step, self._score, mind, layout)
        self._step += 1
        return action

    def reward(self, value: float) -> None:
        """What the action brought."""
        self._score += value
        tell = getattr(self._policy, "reward", None)
        if tell is not None:
            tell(value)


class Painter:
    """Draws frames of one drive, all of one size, and hands them to `take`."""

    def __init__(
        self, environment: gymnasium.Env[Any, Any], world: World, seed: int, take: Callable[[Frame], None],
        every: int = 1,
    ) -> None:  # fmt: skip
        """`every` is how many steps lie between two frames."""
        self.every = every
        self._environment, self._world, self._seed, self._take = environment, world, seed, take
        self._canvas: Canvas | None = None

    def add(self, action: Any, step: int, score: float, mind: Mind | None, layout: Layout | None) -> None:
        """The frame of a step."""
        picture: Any = self._environment.render()
        if self._canvas is None:
            self._canvas = Canvas(self._seed, layout or plain_layout(picture), self._world.action_names)
        self._take(self._canvas.draw(Moment(picture, np.atleast_1d(np.asarray(action)), step, score, mind)))
