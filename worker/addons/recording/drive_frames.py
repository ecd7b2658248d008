"""Turning the steps of a drive into frames: the world, and what the model sees, decodes and dreams."""

from collections.abc import Callable, Iterator
from contextlib import suppress
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
from dreamfleet.worker.addons.recording import canvas
from dreamfleet.worker.addons.recording.parallel_dream import ParallelDream, ParallelDreamConfig
from dreamfleet.worker.scoring.episode import EpisodeConfig, Transition, run_episode
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

    def pictures(self, seen: NDArray[np.uint8]) -> canvas.ModelPictures:
        """The pictures of the step that was followed last; `seen` is its observation."""
        decoded, dreamt = (self._decoder.decode(each)[0] for each in (self._policy.latent, self._imagined))
        return canvas.ModelPictures(seen, decoded, dreamt, self._parallel_dream.since)


class FilmedPolicy:
    """Wraps an agent's policy: draws frames of its steps, each before its action, and of the end, all of one size."""

    def __init__(
        self, agent: Agent, environment: gymnasium.Env[Any, Any], dreaming: ParallelDreamConfig,
        on_frame: Callable[[canvas.Frame], None], every: int,
    ) -> None:  # fmt: skip
        """`every` is the number of steps between two frames, `dreaming.seed` the episode's."""
        self._environment, self._seed, self._on_frame, self._every = environment, dreaming.seed, on_frame, every
        self._world, parameters, bundle = agent.world, agent.parameters, agent.bundle
        self._policy: Any = agent.make_policies()(dreaming.seed)
        self._policy.begin(parameters)
        self._view = None if bundle is None else WorldModelView(bundle, self._policy, parameters, dreaming)
        self._profile = replace(profile_of(agent.reality), score_word=agent.world.score_word)
        self._step, self._score = 0, 0.0
        self._canvas: canvas.Canvas | canvas.PlainCanvas | None = None
        self._last: canvas.DriveFrame | None = None

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Begin an episode."""
        self._policy.begin(parameters)

    def act(self, observation: Any) -> Any:
        """The policy's action; draw a frame if one is due."""
        state = getattr(self._policy, "state", None)
        action = self._policy.act(observation)
        if self._view is not None:
            self._view.follow(self._step, state)
        if self._step % self._every == 0:
            self._draw(observation, action)
        self._step += 1
        return action

    def reward(self, value: float) -> None:
        """Add the reward of the last action, and pass it to the policy."""
        self._score += value
        report_reward = getattr(self._policy, "reward", None)
        if report_reward is not None:
            report_reward(value)

    def end(self, last: Transition) -> None:
        """Draw an end that the environment gave, for a second: the last picture, the score and how it ended."""
        if not last.ended:
            return
        assert self._canvas is not None  # the first step was drawn
        assert self._last is not None
        picture = self._last.track
        with suppress(Exception):  # of an environment that draws no picture after its end
            picture = self._picture()
        end: End = "terminated" if last.terminal else "truncated"
        if self._world.finish and last.info.get(self._world.finish):
            end = "finished"
        text = self._profile.describe_end(end, self._score, last.step)
        frame = self._canvas.draw(replace(self._last, track=picture, step=last.step, score=self._score, end=text))
        for _ in range(max(1, round(self._world.frames_per_second / self._every))):
            self._on_frame(frame)

    def _draw(self, observation: Any, action: Any) -> None:
        picture, pictures = self._picture(), None if self._view is None else self._view.pictures(observation)
        if self._canvas is None:
            layout = canvas.DREAMING if pictures is not None else canvas.plain_layout(picture)
            named = self._world.action_names, self._world.actions
            self._canvas = canvas.make_canvas(self._seed, self._profile, layout, *named)
        self._last = canvas.DriveFrame(picture, np.atleast_1d(np.asarray(action)), self._step, self._score, pictures)
        self._on_frame(self._canvas.draw(self._last))

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


def film(
    agent: Agent, environment: gymnasium.Env[Any, Any], dreaming: ParallelDreamConfig, steps: int,
    on_frame: Callable[[canvas.Frame], None], every: int = 1,
) -> Iterator[Transition]:  # fmt: skip
    """Drive an episode of at most so many steps; yield each, whose frame `on_frame` got before, if one was due.

    `dreaming.seed` is the seed of both. `DreamfleetError` names the seed where a simulator raises anything.
    """
    try:
        filmed = FilmedPolicy(agent, environment, dreaming, on_frame, every)
        for moment in run_episode(environment, filmed, EpisodeConfig(dreaming.seed, steps)):
            yield moment
        filmed.end(moment)
    except DreamfleetError:
        raise
    except (Exception, SystemExit) as error:  # a simulator may raise anything
        raise DreamfleetError(f"the episode of seed {dreaming.seed} failed: {failure_of(error).text}") from error
