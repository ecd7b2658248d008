"""Dream from a step of a real drive on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.worker.addons.inspection.disturbed_rollouts import DisturbedDrive
from dreamfleet.worker.dream.noise import BLOCK_STEPS, EpisodeNoise, stack_draws
from dreamfleet.worker.dream.world import DreamWorld
from dreamfleet.worker.scoring.disturbance import add_disturbance
from dreamfleet.worker.worldmodel.inference import Controllers
from dreamfleet.worker.worldmodel.observation import join_features

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class DreamSegment:
    """A drive's step at which dreams begin, and their length in steps."""

    drive: DisturbedDrive
    step: int
    length: int

    @property
    def steps(self) -> slice:
        """The drive's steps that the dreams replace."""
        return slice(self.step, self.step + self.length)


class DriveDreamer:
    """Dreams from real states on, under a controller with the real disturbance or under the drive's own actions."""

    def __init__(self, bundle: Bundle, controller: Controller, temperature: float, rows: int) -> None:
        fitting = bundle.for_controller(controller)
        self._world, self._controllers = DreamWorld(fitting, temperature), Controllers(fitting)
        self._hidden = bundle.manifest.hidden
        self._parameters = np.repeat(controller.parameters[None], rows, axis=0)

    def dream(self, segment: DreamSegment, *, own: bool) -> tuple[Floats, Doubles]:
        """Return [z, h] `(dreams, steps, features)`, real at the first step, and rewards `(dreams, steps)`.

        With `own` the controller chooses the actions; otherwise the drive's actions are repeated. After its end a dream
        repeats its last state with reward 0.
        """
        drive, rows, features, rewards = segment.drive, len(self._parameters), list[Floats](), list[Doubles]()
        noises = [
            EpisodeNoise((drive.seed << 20) + segment.step * rows + row, self._world.chance, self._world.bars)
            for row in range(rows)
        ]
        latent, state = (np.repeat(each[segment.step][None], rows, axis=0) for each in (drive.latent, drive.state))
        going, actions = np.ones((rows, 1), dtype=bool), self._world.actions
        for action, push in zip(drive.action[segment.steps], drive.push[segment.steps], strict=True):
            features.append(join_features(latent, state, self._hidden))
            chosen = self._controllers.act(self._parameters, latent, state) if own else None
            done = np.repeat(action[None], rows, axis=0)
            if chosen is not None:
                done = add_disturbance(actions, chosen, push[None])
            draw = stack_draws([noise.next() for noise in noises], axis=0).map(np.concatenate)
            moment = self._world.imagine(latent, done, state, draw, chosen)
            rewards.append(np.where(going[:, 0], moment.reward, 0.0))
            latent, state = np.where(going, moment.latent, latent), np.where(going, moment.state, state)
            going = going & ~moment.done[:, None]
        return np.stack(features, axis=1), np.stack(rewards, axis=1)

    def predict_next(self, drive: DisturbedDrive) -> tuple[Floats, Doubles]:
        """Predict each step from the real step before: [z, h] `(T, features)` and rewards `(T,)`.

        z is the dreamt one, except for the first step's, which is real; h is real.
        """
        noise = EpisodeNoise(drive.seed, self._world.chance, self._world.bars)
        pieces = [noise.draw_block() for _ in range(0, len(drive), BLOCK_STEPS)]
        draw = stack_draws(pieces, axis=0).map(lambda part: part.reshape(-1, part.shape[-1])[: len(drive)])
        moment = self._world.imagine(drive.latent, drive.action, drive.state, draw)
        latent = np.concatenate([drive.latent[:1], moment.latent[:-1]])
        return join_features(latent, drive.state, self._hidden), moment.reward
