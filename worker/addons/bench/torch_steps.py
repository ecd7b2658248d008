"""A policy step and a dream step in torch, one operation at a time, as a comparison for the ONNX graphs."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.distributions import Categorical, Normal

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.schema.validation import from_plain
from dreamfleet.worker.worldmodel.vae import VAE
from dreamfleet.worker.worldmodel.vae_config import VAEConfig


def make_torch_step(bundle: Bundle, picture: NDArray[np.uint8], parameters: NDArray[np.float32]) -> Callable[[], Any]:
    """Return a call that makes one policy step of the bundle's sizes at batch 1 on one thread, with random weights."""
    torch.set_num_threads(1)
    manifest = bundle.manifest
    config = from_plain(VAEConfig, manifest.models["vae"]) if manifest.models else VAEConfig(latent=manifest.latent)
    vae, cell = VAE(config).eval(), nn.LSTMCell(manifest.latent + manifest.actions, manifest.hidden)
    weights, biases = (torch.from_numpy(each[0]) for each in bundle.default_shape.unpack(parameters)[0])
    state = (torch.zeros(1, manifest.hidden), torch.zeros(1, manifest.hidden))

    def step() -> Any:
        with torch.no_grad():
            pixels = torch.from_numpy(picture).permute(0, 3, 1, 2).float() / 255
            latent, _ = vae.encode(pixels)
            squashed = torch.tanh(torch.cat([latent, state[0]], dim=1) @ weights.T + biases)
            steer, gas, brake = squashed.unbind(dim=1)
            action = torch.stack([steer, (gas + 1) / 2, brake.clamp(0, 1)], dim=1)
            return action, cell(torch.cat([latent, action], dim=1), state)

    return step


def has_cuda() -> bool:
    """Whether torch has a graphics processor here."""
    return bool(torch.cuda.is_available())


def make_torch_dream(bundle: Bundle, batch: int) -> Callable[[], Any]:
    """Return a call that dreams one step of `batch` rows with torch modules and distributions on one thread."""
    torch.set_num_threads(1)
    manifest = bundle.manifest
    mixtures = int(manifest.models["mdnrnn"]["mixtures"])
    cell = nn.LSTMCell(manifest.latent + manifest.actions, manifest.hidden)
    heads = nn.Linear(manifest.hidden, 3 * mixtures * manifest.latent + 1)
    weights = torch.randn(batch, manifest.actions, manifest.latent + manifest.hidden)
    biases, latent = torch.randn(batch, manifest.actions), torch.randn(batch, manifest.latent)
    state = (torch.zeros(batch, manifest.hidden), torch.zeros(batch, manifest.hidden))
    temperature = 1.25

    def step() -> Any:
        with torch.no_grad():
            features = torch.cat([latent, state[0]], dim=1)
            squashed = torch.tanh(torch.bmm(weights, features[:, :, None])[:, :, 0] + biases)
            steer, gas, brake = squashed.unbind(dim=1)
            action = torch.stack([steer, (gas + 1) / 2, brake.clamp(0, 1)], dim=1)
            hidden, _ = after = cell(torch.cat([latent, action], dim=1), state)
            out = heads(hidden)
            shape = (batch, manifest.latent, mixtures)
            logits, means, deviations = (part.reshape(shape) for part in out[:, :-1].chunk(3, dim=1))
            chosen = Categorical(logits=logits / temperature).sample()[:, :, None]  # type: ignore[no-untyped-call]
            mean, deviation = means.gather(2, chosen)[:, :, 0], deviations.gather(2, chosen)[:, :, 0]
            dreamt = Normal(mean, deviation.exp() * temperature**0.5).sample()  # type: ignore[no-untyped-call]
            return dreamt, after, torch.sigmoid(out[:, -1])

    return step
