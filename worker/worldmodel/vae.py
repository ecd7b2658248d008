"""The variational autoencoder of Ha & Schmidhuber 2018 (appendix A.1): a 64x64 picture as 32 Gaussian latents."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional


@dataclass(frozen=True)
class VAEConfig:
    """Sizes of the paper's VAE."""

    latent: int = 32
    channels: tuple[int, ...] = (32, 64, 128, 256)
    kl_tolerance: float = 0.5  # nats a latent below which the divergence costs nothing


class VAE(nn.Module):
    """Pictures `(N, 3, 64, 64)` in [0, 1] to mu and logvar `(N, latent)`, and back."""

    def __init__(self, config: VAEConfig) -> None:
        super().__init__()
        self.config = config
        first, second, third, fourth = config.channels
        self.encoder = nn.Sequential(
            nn.Conv2d(3, first, 4, stride=2), nn.ReLU(),
            nn.Conv2d(first, second, 4, stride=2), nn.ReLU(),
            nn.Conv2d(second, third, 4, stride=2), nn.ReLU(),
            nn.Conv2d(third, fourth, 4, stride=2), nn.ReLU(),
            nn.Flatten(),
        )  # fmt: skip
        self.flat = 4 * fourth
        self.mu = nn.Linear(self.flat, config.latent)
        self.logvar = nn.Linear(self.flat, config.latent)
        self.dense = nn.Linear(config.latent, self.flat)
        self.decoder = nn.Sequential(
            nn.ConvTranspose2d(self.flat, third, 5, stride=2), nn.ReLU(),
            nn.ConvTranspose2d(third, second, 5, stride=2), nn.ReLU(),
            nn.ConvTranspose2d(second, first, 6, stride=2), nn.ReLU(),
            nn.ConvTranspose2d(first, 3, 6, stride=2), nn.Sigmoid(),
        )  # fmt: skip

    def encode(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance of each latent."""
        flat = self.encoder(pictures)
        return self.mu(flat), self.logvar(flat)

    def decode(self, latents: Tensor) -> Tensor:
        """Pictures `(N, 3, 64, 64)` in [0, 1]."""
        pictures: Tensor = self.decoder(self.dense(latents)[:, :, None, None])
        return pictures

    def loss(self, pictures: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Summed squared error + max(KL, tolerance), its two terms beside it; `noise` `(N, latent)` standard normal."""
        mu, logvar = self.encode(pictures)
        decoded = self.decode(mu + noise * torch.exp(0.5 * logvar))
        error = functional.mse_loss(decoded, pictures, reduction="none").sum(dim=(1, 2, 3)).mean()
        divergence = -0.5 * (1 + logvar - mu.square() - logvar.exp()).sum(dim=1)
        floor = self.config.kl_tolerance * self.config.latent
        return error + divergence.clamp(min=floor).mean(), error, divergence.mean()
