"""A drive as a video: the world, what the model sees of it, what it makes of that, and what it dreams."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.errors import DatasetError
from dreamfleet.common.stopping import Stop, never
from dreamfleet.worker.dream.daydream import Daydream, DaydreamConfig, can_dream
from dreamfleet.worker.scoring.agents import Agent
from dreamfleet.worker.scoring.episode import Course, play
from dreamfleet.worker.tasks.api import World
from dreamfleet.worker.tools.canvas import AWAKE, DREAMING, Canvas, Dreamt, Layout, Mind, Moment, plain_layout
from dreamfleet.worker.worldmodel.inference import Decoder


def record(
    agent: Agent, seed: int, steps: int, out: Path, dreaming: DaydreamConfig | None = None,
    on_step: Callable[[int], None] = lambda _steps: None, stop: Stop = never,
) -> float:  # fmt: skip
    """Drive one episode in the agent's judge into an mp4; returns its score.

    Of an agent with a world model it shows what that sees and decodes beside the drive, and dreams if it can. If `stop`
    asks for it, the video ends early, with a step at least.
    """
    environment = agent.make_judge("rgb_array")
    policy: Any = agent.make_policies()(seed)
    policy.begin(agent.parameters)
    config, bundle = dreaming or DaydreamConfig(seed=seed), agent.bundle
    thoughts = None if bundle is None else Thoughts(bundle, policy, agent.parameters, config)
    score = 0.0
    with Film(out, environment, agent.world, seed) as film:
        for moment in play(environment, Filmed(policy, film, thoughts), Course(seed, steps)):
            score += moment.reward
            on_step(moment.step)
            if stop():
                break
    environment.close()
    return score


class Thoughts:
    """What a world model sees, decodes and dreams while its controller drives."""

    def __init__(self, bundle: Bundle, policy: Any, parameters: NDArray[np.float32], dreaming: DaydreamConfig) -> None:
        self._policy, self._decoder = policy, Decoder(bundle)
        self._daydream = Daydream(bundle, parameters, dreaming) if can_dream(bundle) else None
        self.layout = DREAMING if self._daydream else AWAKE

    def after(self, step: int, seen: NDArray[np.uint8], state: Any) -> Mind:
        """The pictures at a step; `state` is the policy's from before it acted."""
        decoded, dreamt = self._decoder.decode(self._policy.latent)[0], None
        if self._daydream is not None:
            imagined = self._daydream.follow(step, self._policy.latent, state)
            dreamt = Dreamt(self._decoder.decode(imagined)[0], self._daydream.since)
        return Mind(seen, decoded, dreamt)


class Filmed:
    """A policy whose every step becomes a frame, as the world looks before the action."""

    def __init__(self, policy: Any, film: Film, thoughts: Thoughts | None) -> None:
        self._policy, self._film, self._thoughts = policy, film, thoughts
        self._step, self._score = 0, 0.0

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Begin an episode."""
        self._policy.begin(parameters)

    def act(self, observation: Any) -> Any:
        """The policy's action, and a frame of it."""
        state = getattr(self._policy, "state", None)
        action = self._policy.act(observation)
        mind, layout = None, None
        if self._thoughts is not None:
            mind, layout = self._thoughts.after(self._step, observation, state), self._thoughts.layout
        self._film.add(action, self._step, self._score, mind, layout)
        self._step += 1
        return action

    def reward(self, value: float) -> None:
        """What the action brought."""
        self._score += value
        tell = getattr(self._policy, "reward", None)
        if tell is not None:
            tell(value)


class Film:
    """An mp4 that grows frame by frame; what was filmed until an interruption can be played."""

    def __init__(self, out: Path, environment: gymnasium.Env[Any, Any], world: World, seed: int) -> None:
        self._out, self._environment, self._world, self._seed = out, environment, world, seed
        self._canvas: Canvas | None = None

    def __enter__(self) -> Film:
        try:
            self._out.parent.mkdir(parents=True, exist_ok=True)
            self._container: Any = av.open(str(self._out), "w")
        except OSError as error:
            raise DatasetError(f"cannot write {self._out}: {error.strerror}; choose another --out") from error
        return self

    def __exit__(self, *_error: object) -> None:
        if self._canvas is not None:
            self._container.mux(self._stream.encode())
        self._container.close()

    def add(self, action: Any, step: int, score: float, mind: Mind | None, layout: Layout | None) -> None:
        """The frame of a step."""
        picture: Any = self._environment.render()
        if self._canvas is None:
            layout = layout or plain_layout(picture)
            self._canvas = Canvas(self._seed, layout, self._world.action_names)
            self._stream = _open_stream(self._container, layout, self._world.frames_per_second)
        frame = self._canvas.draw(Moment(picture, np.atleast_1d(np.asarray(action)), step, score, mind))
        self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(frame, "rgb24")))


def _open_stream(container: Any, layout: Layout, frames_per_second: int) -> Any:
    stream = container.add_stream("libx264", rate=frames_per_second)
    stream.width, stream.height = layout.size
    stream.pix_fmt = "yuv420p"
    stream.time_base = Fraction(1, frames_per_second)
    stream.options = {"crf": "23", "preset": "veryfast"}
    return stream
