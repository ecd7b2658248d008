"""The variational autoencoder of Ha & Schmidhuber 2018 (appendix A.1) and of its successors.

A checkpoint has the names of its parameters. `export.py`, `worker/training/checkpoint.py` and
`worker/addons/importing/` read them. Pages: sources.md.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from dreamfleet.worker.worldmodel.vae_config import LEAK, ConvolutionLayer, VAEConfig


class VAELoss(NamedTuple):
    """The loss to minimise, the same without factors and pixels' weights, and its parts: squared error, KL in nats."""

    weighted: Tensor
    plain: Tensor
    error: Tensor
    divergence: Tensor


class PixelWeights(NamedTuple):
    """How often the error of each pixel counts: `1 + factor * |x - mean| / deviation`, `|x - mean|` over its channels.

    `mean` `(3, side, side)` is the mean picture, in [0, 1], and `deviation` the mean of `|x - mean|` over pictures. A
    weight is 1 where a picture is as its mean, and `1 + factor` on average.
    """

    mean: Tensor
    deviation: float
    factor: float

    def of(self, pictures: Tensor) -> Tensor:
        """The weights `(N, 1, side, side)` of pictures `(N, 3, side, side)`."""
        return 1 + self.factor / self.deviation * (pictures - self.mean).abs().mean(dim=1, keepdim=True)


class Down(nn.Conv2d):
    """A convolution that may pad one more row and column at the end than at the beginning."""

    def __init__(self, layer: ConvolutionLayer) -> None:
        super().__init__(layer.inputs, layer.outputs, layer.kernel, layer.stride, layer.before)
        self._more = layer.after - layer.before

    def forward(self, pictures: Tensor) -> Tensor:
        """The outputs."""
        return super().forward(functional.pad(pictures, (0, self._more, 0, self._more)) if self._more else pictures)


class Up(nn.ConvTranspose2d):
    """A transposed convolution that may crop one more row and column at the end than at the beginning."""

    def __init__(self, layer: ConvolutionLayer) -> None:
        super().__init__(layer.inputs, layer.outputs, layer.kernel, layer.stride, layer.before)
        self._more = layer.after - layer.before

    def forward(self, pictures: Tensor, output_size: list[int] | None = None) -> Tensor:
        """The outputs."""
        whole = super().forward(pictures, output_size)
        return whole[..., : -self._more, : -self._more] if self._more else whole


class VAE(nn.Module):
    """Maps pictures `(N, 3, side, side)` in [0, 1] to mu and logvar `(N, latent)`, and latents back to pictures."""

    def __init__(self, config: VAEConfig) -> None:
        super().__init__()
        self.config = config
        layers: list[nn.Module] = []
        for each in config.down:
            layers += [Down(each), *_layers_after(config, each.outputs)]
        self.encoder = nn.Sequential(*layers)
        first, side = config.up[0].inputs, config.decoder_sides[0]
        if config.columns:  # a latent sees its column of the map and those beside it, as every other column's does
            kernel: Any = {"kernel_size": (side, 3), "padding": (0, 1)}
            layers = [nn.Conv2d(config.channels[-1], config.columns, **kernel) for _ in range(2)]
            layers.append(nn.ConvTranspose2d(config.columns, first, **kernel))
        else:
            layers = [nn.Linear(config.flat, config.latent) for _ in range(2)]
            layers.append(nn.Linear(config.latent, first * side**2))
        self.mu, self.logvar, self.dense = layers
        self._start = (first, side, side)
        self._latents = (config.columns, 1, side) if config.columns else (config.latent,)
        layers = []
        for each in config.up:
            layers += [Up(each), *_layers_after(config, each.outputs)]
        self.decoder = nn.Sequential(*layers[: 1 - config.modules_a_layer], nn.Sigmoid())

    def encode(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance `(N, latent)` of pictures."""
        seen = self.encoder(pictures)
        seen = seen if self.config.columns else seen.flatten(1)
        return self.mu(seen).flatten(1), self.logvar(seen).flatten(1)

    def freeze_encoder(self) -> None:
        """Let only the decoder learn, so that latents, and models trained on them, stay valid."""
        for part in (self.encoder, self.mu, self.logvar):
            part.eval().requires_grad_(requires_grad=False)

    def decode(self, latents: Tensor) -> Tensor:
        """Decode latents `(N, latent)` to pictures `(N, 3, side, side)` in [0, 1]."""
        dense = self.dense(latents.reshape(-1, *self._latents))
        dense = _activation(self.config)(dense) if self.config.activate_dense else dense
        pictures: Tensor = self.decoder(dense.reshape(-1, *self._start))
        return pictures

    def loss(self, pictures: Tensor, noise: Tensor, pixels: PixelWeights | None = None) -> VAELoss:
        """The configured loss and its parts; `noise` `(N, latent)` is standard normal.

        With the error factor F, the paper's is F * squared error + max(KL, tolerance), the notebook's
        F * 1000 * mean square + KL. With `pixels` the squares are weighted.
        """
        mu, logvar = self.encode(pictures)
        decoded = self.decode(mu + noise * torch.exp(0.5 * logvar))
        squares = functional.mse_loss(decoded, pictures, reduction="none")
        error = squares.sum(dim=(1, 2, 3)).mean()
        weighed = error if pixels is None else (pixels.of(pictures) * squares).sum(dim=(1, 2, 3)).mean()
        divergence = -0.5 * (1 + logvar - mu.square() - logvar.exp()).sum(dim=1)
        if self.config.loss == "notebook":
            scale, floored = 1000 / (3 * self.config.picture**2), divergence
        else:
            scale, floored = 1.0, divergence.clamp(min=self.config.kl_tolerance * self.config.latent)
        weighted = self.config.error_factor * (scale * weighed) + floored.mean()
        return VAELoss(weighted, scale * error + floored.mean(), error, divergence.mean())


def _layers_after(config: VAEConfig, channels: int) -> list[nn.Module]:
    """The modules after a convolution: batch normalisation, activation and dropout, as configured."""
    modules: list[nn.Module] = [nn.BatchNorm2d(channels)] if config.batch_norm else []
    modules.append(_activation(config))
    return [*modules, nn.Dropout(config.dropout)] if config.dropout else modules


def _activation(config: VAEConfig) -> nn.Module:
    return nn.ReLU() if config.activation == "relu" else nn.LeakyReLU(LEAK)
