"""Turning the steps of a drive into frames: the world, and what the model sees, decodes and dreams."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.worlds.profile import End
from dreamfleet.common.worlds.score_words import profile_of
from dreamfleet.worker.addons.evaluation.agents import Agent
from dreamfleet.worker.addons.recording.canvas import (
    DREAMING,
    Canvas,
    DreamPicture,
    DriveFrame,
    Frame,
    ModelPictures,
    plain_layout,
)
from dreamfleet.worker.addons.recording.parallel_dream import ParallelDream, ParallelDreamConfig
from dreamfleet.worker.scoring.episode import Transition
from dreamfleet.worker.scoring.failure_cause import failure_of
from dreamfleet.worker.tasks.pictures import drawn_pixels
from dreamfleet.worker.worldmodel.inference import Decoder


class WorldModelView:
    """Decodes and dreams with a world model while its controller drives."""

    def __init__(
        self, bundle: Bundle, policy: Any, parameters: NDArray[np.float32], dreaming: ParallelDreamConfig
    ) -> None:
        self._policy, self._decoder = policy, Decoder(bundle)
        self._parallel_dream = ParallelDream(bundle, parameters, dreaming)

    def follow(self, step: int, state: Any) -> None:
        """Dream this step; `state` is the policy's before it acted."""
        self._imagined = self._parallel_dream.follow(step, self._policy.latent, state)

    def pictures(self, seen: NDArray[np.uint8]) -> ModelPictures:
        """The pictures of the step that was followed last; `seen` is its observation."""
        dreamt = DreamPicture(self._decoder.decode(self._imagined)[0], self._parallel_dream.since)
        return ModelPictures(seen, self._decoder.decode(self._policy.latent)[0], dreamt)


class FilmedPolicy:
    """Wraps a policy and paints frames of its steps, each before its action, and of the episode's end."""

    def __init__(self, policy: Any, painter: FramePainter, model_view: WorldModelView | None) -> None:
        self._policy, self._painter, self._model_view = policy, painter, model_view
        self._step, self._score = 0, 0.0

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Begin an episode."""
        self._policy.begin(parameters)

    def act(self, observation: Any) -> Any:
        """The policy's action; paint a frame if one is due."""
        state = getattr(self._policy, "state", None)
        action = self._policy.act(observation)
        if self._model_view is not None:
            self._model_view.follow(self._step, state)
        if self._step % self._painter.every == 0:
            pictures = None if self._model_view is None else self._model_view.pictures(observation)
            self._painter.add(action, self._step, self._score, pictures)
        self._step += 1
        return action

    def reward(self, value: float) -> None:
        """Add the reward of the last action, and pass it to the policy."""
        self._score += value
        report_reward = getattr(self._policy, "reward", None)
        if report_reward is not None:
            report_reward(value)

    def end(self, last: Transition) -> None:
        """Paint the end of an episode that its environment ended; `last` is its last step."""
        if last.ended:
            self._painter.hold_end(last, self._score)


class FramePainter:
    """Draws frames of one drive, all of the same size, and passes them to `on_frame`."""

    def __init__(
        self, environment: gymnasium.Env[Any, Any], agent: Agent, seed: int, on_frame: Callable[[Frame], None],
        every: int = 1,
    ) -> None:  # fmt: skip
        """`every` is the number of steps between two frames."""
        self.every = every
        self._environment, self._world, self._seed, self._on_frame = environment, agent.world, seed, on_frame
        self._profile = replace(profile_of(agent.reality), score_word=agent.world.score_word)
        self._canvas: Canvas | None = None
        self._last: DriveFrame | None = None

    def add(self, action: Any, step: int, score: float, pictures: ModelPictures | None) -> None:
        """Draw the frame of a step."""
        picture = self._picture()
        if self._canvas is None:
            layout = DREAMING if pictures is not None else plain_layout(picture)
            self._canvas = Canvas(self._seed, self._profile, layout, self._world.action_names, self._world.actions)
        self._last = DriveFrame(picture, np.atleast_1d(np.asarray(action)), step, score, pictures)
        self._on_frame(self._canvas.draw(self._last))

    def hold_end(self, last: Transition, score: float) -> None:
        """Draw what was painted last as the episode's end, for a second: its last picture, score and how it ended."""
        assert self._canvas is not None  # the first step was painted
        assert self._last is not None
        picture = self._last.track
        with suppress(Exception):  # of an environment that draws no picture after its end
            picture = self._picture()
        end: End = "terminated" if last.terminal else "truncated"
        if self._world.finish and last.info.get(self._world.finish):
            end = "finished"
        text = self._profile.describe_end(end, score, last.step)
        frame = self._canvas.draw(replace(self._last, track=picture, step=last.step, score=score, end=text))
        for _ in range(max(1, round(self._world.frames_per_second / self.every))):
            self._on_frame(frame)

    def _picture(self) -> NDArray[np.uint8]:
        """The environment's picture `(height, width, 3)`; `UsageError` if it draws none."""
        drawn: Any = None
        with suppress(NotImplementedError):  # gymnasium's default `render`
            drawn = self._environment.render()
        found = drawn_pixels(drawn)
        if found is None:
            raise UsageError(
                f"{type(self._environment.unwrapped).__name__} draws no pictures: in the render mode rgb_array its "
                "`render` must return an array (height, width, 3)"
            )
        return found


@contextmanager
def episode_errors(seed: int) -> Iterator[None]:
    """Turn what a simulator raises into a `DreamfleetError` that names the seed."""
    try:
        yield
    except DreamfleetError:
        raise
    except (Exception, SystemExit) as error:  # a simulator may raise anything
        raise DreamfleetError(f"the episode of seed {seed} failed: {failure_of(error).text}") from error
