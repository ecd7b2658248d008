"""Who tells from [z, h] alone whether a car is off the road: of a dream nothing else is known.

A dreamt latent is drawn by chance and noisier than a picture's, so the probe is fitted on latents that the model
foresees one step ahead of real ones, with the truth of the step that came.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.inspection.disturbed_rollouts import OFF, OFFSET, DisturbedDrive, first_sustained
from dreamfleet.worker.inspection.probe import LinearProbe

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class RoadOutcome:
    """What happened from a beginning on, of each dream `(dreams, steps)`; of reality one row.

    `off` is whether the car is off the road, `offset` how far from the centre line, `reward` what each step brought.
    """

    off: NDArray[np.bool_]
    offset: Doubles
    reward: Doubles

    def summarise(self, lasting: int) -> dict[str, float]:
        """Means over the dreams; the road is lost after `lasting` steps in a row off it, and the end is as long."""
        return {
            "lost": float((first_sustained(self.off, lasting) >= 0).mean()),
            "off_at_end": float(self.off[:, -lasting:].mean()),
            "offset_at_end": float(self.offset[:, -lasting:].mean()),
            "reward": float(self.reward.sum(axis=1).mean()),
        }


class RoadProbe:
    """Linear probes of being off the road, and of the distance from its centre line, on foreseen [z, h]."""

    def __init__(self, drives: Sequence[DisturbedDrive], foreseen: Sequence[Floats], opening: int) -> None:
        features = np.concatenate([each[opening:] for each in foreseen])
        off = np.concatenate([drive.truth[OFF][opening:] for drive in drives])
        offset = np.abs(np.concatenate([drive.truth[OFFSET][opening:] for drive in drives]))
        often = min(max(float(off.mean()), 1e-6), 1 - 1e-6)
        balanced = np.where(off > 0, 0.5 / often, 0.5 / (1 - often))  # both kinds weigh the same
        self._probe = LinearProbe.fit(features, np.stack([off, offset], axis=1), balanced)

    def outcome(self, features: Floats, reward: Doubles) -> RoadOutcome:
        """The course of features `(rows, steps, features)` and rewards `(rows, steps)`."""
        told = self._probe.predict(features.astype(np.float64))
        return RoadOutcome(told[..., 0] > 0.5, told[..., 1], reward)
