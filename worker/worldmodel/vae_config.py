"""What a VAE is made of; apart from the module, so that what only configures needs no torch."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.worldmodel.factors import check_factors, factor

LEAK = 0.2  # slope of the leaky activation below zero
KERNEL = 4
PAPER_SIDES = (1, 5, 13, 30, 64)  # of the paper's decoder; its kernels 5, 5, 6, 6 follow


@dataclass(frozen=True)
class VAEConfig:
    """Layers and loss; the defaults are the paper's."""

    picture: int = 64  # height and width
    latent: int = 32
    channels: tuple[int, ...] = (32, 64, 128, 256)
    padding: Literal["valid", "same"] = "valid"
    activation: Literal["relu", "leaky_relu"] = "relu"
    batch_norm: bool = False
    dropout: float = 0.0
    loss: Literal["paper", "notebook"] = "paper"
    kl_tolerance: float = 0.5  # of the paper's loss: nats a latent below which the divergence costs nothing
    dense: int = 0  # inputs of the paper's decoder; 0: as many as the encoder's outputs
    error_factor: float = factor("weighs the reconstruction error against the divergence; above 1 latents keep more")

    def __post_init__(self) -> None:
        if self.picture not in (64, 96):
            raise UsageError(f"a VAE's pictures are 64 or 96 pixels wide, not {self.picture}")
        if len(self.channels) != 4 or min(self.channels) < 1 or self.latent < 1:
            raise UsageError(f"a VAE has 4 layers of channels and a latent, not {self.channels}, {self.latent}")
        if not 0 <= self.dropout < 1 or self.kl_tolerance < 0 or self.dense < 0:
            raise UsageError("--dropout must be from 0 to below 1; a tolerance and a width must not be negative")
        check_factors(self, "error_factor")

    @property
    def sides(self) -> tuple[int, ...]:
        """Height and width of the picture and after each convolution of kernel 4, stride 2."""
        sides = [self.picture]
        for _ in self.channels:
            sides.append(sides[-1] // 2 if self.padding == "same" else (sides[-1] - KERNEL) // 2 + 1)
        return tuple(sides)

    @property
    def flat(self) -> int:
        """Outputs of the last convolution."""
        return self.channels[-1] * self.sides[-1] ** 2

    @property
    def decoder_sides(self) -> tuple[int, ...]:
        """Height and width before and after each transposed convolution: the paper's, else the encoder's mirrored."""
        paper = (self.picture, self.padding) == (64, "valid")
        return PAPER_SIDES if paper else self.sides[::-1]

    @property
    def decoder_channels(self) -> tuple[int, ...]:
        """Channels before and after each transposed convolution."""
        side = self.decoder_sides[0]
        return ((self.dense or self.flat) if side == 1 else self.channels[-1], *self.channels[-2::-1], 3)

    @property
    def decoder_kernels(self) -> tuple[int, ...]:
        """Kernel of each transposed convolution of stride 2."""
        if self.padding == "same":
            return (KERNEL,) * len(self.channels)
        return tuple(after - 2 * (before - 1) for before, after in pairwise(self.decoder_sides))

    @property
    def modules_a_layer(self) -> int:
        """Modules of a layer: convolution, activation, and between and behind them what is configured."""
        return 2 + self.batch_norm + (self.dropout > 0)


PAPER = VAEConfig()
NOTEBOOK = VAEConfig(picture=96, channels=(32, 64, 64, 128), padding="same", loss="notebook")
ARTICLE = VAEConfig(channels=(32, 64, 64, 128), dense=1024)  # AppliedDataSciencePartners/WorldModels
