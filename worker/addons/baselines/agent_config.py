"""The configuration of the recurrent duelling network: layers, pictures, choices. Parsing its flags needs no torch."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from dreamfleet.common.artifacts.actions import FIVE_CHOICES
from dreamfleet.common.artifacts.trained_agent import MAX_FRAME_SKIP
from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError

MOST_PARAMETERS = 50_000_000  # readers of an exported network bound its size

# Steering, gas, brake of each choice, in gymnasium's order: nothing, right, left, gas, brake.
CHOICES: dict[str, tuple[tuple[float, ...], ...]] = {
    "gymnasium": FIVE_CHOICES.choices,
    "notebook": ((0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, 1)),
}


@dataclass(frozen=True)
class AgentConfig:
    """Layers, pictures and choices: all that a trained network needs besides its weights.

    The layers are those of Hausknecht & Stone 2015 (arXiv:1507.06527) with the streams of Wang et al. 2016
    (arXiv:1511.06581).
    """

    picture: int = option(64, "height and width of its pictures: 64, or 96 for the whole observation")
    choices: Literal["gymnasium", "notebook"] = option(
        "gymnasium", "its five actions: steering 0.6, gas 0.2, brake 0.8 as gymnasium has them, or 1 each (notebook)"
    )
    frame_skip: int = option(1, "steps for which a choice is held")
    channels: tuple[int, ...] = option((32, 64, 64), "of each convolution")
    kernels: tuple[int, ...] = option((8, 4, 3), "of each convolution")
    strides: tuple[int, ...] = option((4, 2, 1), "of each convolution")
    hidden: int = option(512, "units of the LSTM")
    heads: Literal["linear", "softmax"] = option(
        "linear", "softmax bounds the advantages to 0..1, as the notebook does; they then cannot represent returns"
    )

    def __post_init__(self) -> None:
        if self.picture not in (64, 96):
            raise UsageError(f"picture must be 64 or 96, not {self.picture}")
        counts = {len(self.channels), len(self.kernels), len(self.strides)}
        if len(counts) > 1 or 0 in counts:
            raise UsageError("channels, kernels and strides must name the same number of layers, at least one")
        if min(*self.channels, *self.kernels, *self.strides, self.hidden, self.frame_skip) < 1:
            raise UsageError("channels, kernels, strides, hidden and frame_skip must be at least 1")
        if min(self.sides) < 1:
            raise UsageError(f"kernels and strides leave nothing of {self.picture} pixels: make them smaller")
        if self.frame_skip > MAX_FRAME_SKIP:
            raise UsageError(f"frame_skip must be at most {MAX_FRAME_SKIP}, not {self.frame_skip}")
        if self.parameters > MOST_PARAMETERS:
            raise UsageError(
                f"these layers have {self.parameters:,} parameters, at most {MOST_PARAMETERS:,} are allowed: make "
                "channels, kernels or hidden smaller"
            )

    @property
    def sides(self) -> tuple[int, ...]:
        """Height (= width) of the picture, then after each convolution."""
        sides = [self.picture]
        for kernel, stride in zip(self.kernels, self.strides, strict=True):
            sides.append((sides[-1] - kernel) // stride + 1)
        return tuple(sides)

    @property
    def flat(self) -> int:
        """The number of outputs of the last convolution."""
        return int(self.channels[-1] * self.sides[-1] ** 2)

    @property
    def channel_pairs(self) -> tuple[tuple[int, int], ...]:
        """Channels before and after each convolution."""
        return tuple(pairwise((3, *self.channels)))

    @property
    def parameters(self) -> int:
        """The number of weights of the convolutions and the LSTM, which are nearly all; biases are not counted."""
        layers = zip(self.channel_pairs, self.kernels, strict=True)
        looking = sum(before * after * kernel**2 for (before, after), kernel in layers)
        return int(looking + 4 * self.hidden * (self.flat + self.hidden))

    @property
    def table(self) -> tuple[tuple[float, ...], ...]:
        """Steering, gas and brake of each choice: `(choices, 3)`."""
        return CHOICES[self.choices]
