"""The variational autoencoder of Ha & Schmidhuber 2018 (appendix A.1) and its successors': a picture as latents."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from common.errors import UsageError

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

    def __post_init__(self) -> None:
        if self.picture not in (64, 96):
            raise UsageError(f"a VAE's pictures are 64 or 96 pixels wide, not {self.picture}")
        if len(self.channels) != 4 or min(self.channels) < 1 or self.latent < 1:
            raise UsageError(f"a VAE has 4 layers of channels and a latent, not {self.channels}, {self.latent}")
        if not 0 <= self.dropout < 1 or self.kl_tolerance < 0 or self.dense < 0:
            raise UsageError("--dropout must be from 0 to below 1; a tolerance and a width must not be negative")

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


class VAE(nn.Module):
    """Pictures `(N, 3, side, side)` in [0, 1] to mu and logvar `(N, latent)`, and back."""

    def __init__(self, config: VAEConfig) -> None:
        super().__init__()
        self.config = config
        padding = 1 if config.padding == "same" else 0
        layers: list[nn.Module] = []
        for before, after in pairwise((3, *config.channels)):
            layers += [nn.Conv2d(before, after, KERNEL, stride=2, padding=padding), *_after(config, after)]
        self.encoder = nn.Sequential(*layers, nn.Flatten())
        self.mu = nn.Linear(config.flat, config.latent)
        self.logvar = nn.Linear(config.flat, config.latent)
        self._start = (config.decoder_channels[0], *[config.decoder_sides[0]] * 2)
        self.dense = nn.Linear(config.latent, self._start[0] * self._start[1] ** 2)
        layers = []
        for (before, after), kernel in zip(pairwise(config.decoder_channels), config.decoder_kernels, strict=True):
            layers += [nn.ConvTranspose2d(before, after, kernel, stride=2, padding=padding), *_after(config, after)]
        self.decoder = nn.Sequential(*layers[: 1 - config.modules_a_layer], nn.Sigmoid())

    def encode(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance of each latent."""
        flat = self.encoder(pictures)
        return self.mu(flat), self.logvar(flat)

    def decode(self, latents: Tensor) -> Tensor:
        """Pictures `(N, 3, side, side)` in [0, 1]."""
        pictures: Tensor = self.decoder(self.dense(latents).reshape(-1, *self._start))
        return pictures

    def loss(self, pictures: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The configured loss, and summed squared error and KL in nats beside it; `noise` `(N, latent)` normal.

        The paper's: error + max(KL, tolerance). The notebook's: 1000 x mean square + KL.
        """
        mu, logvar = self.encode(pictures)
        decoded = self.decode(mu + noise * torch.exp(0.5 * logvar))
        error = functional.mse_loss(decoded, pictures, reduction="none").sum(dim=(1, 2, 3)).mean()
        divergence = -0.5 * (1 + logvar - mu.square() - logvar.exp()).sum(dim=1)
        if self.config.loss == "notebook":
            pixels = 3 * self.config.picture**2
            return 1000 / pixels * error + divergence.mean(), error, divergence.mean()
        floor = self.config.kl_tolerance * self.config.latent
        return error + divergence.clamp(min=floor).mean(), error, divergence.mean()


def _after(config: VAEConfig, channels: int) -> list[nn.Module]:
    """What stands behind a convolution."""
    modules: list[nn.Module] = [nn.BatchNorm2d(channels)] if config.batch_norm else []
    modules.append(nn.ReLU() if config.activation == "relu" else nn.LeakyReLU(LEAK))
    return [*modules, nn.Dropout(config.dropout)] if config.dropout else modules
