"""The policy step in torch, one operation at a time: what the ONNX graph is measured against."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from common.bundle import Bundle
from common.codec import from_plain
from worker.worldmodel.vae import VAE
from worker.worldmodel.vae_config import VAEConfig


def make_torch_step(bundle: Bundle, picture: NDArray[np.uint8], parameters: NDArray[np.float32]) -> Callable[[], Any]:
    """A call that makes one step of the bundle's sizes at batch 1, on one thread; the weights' values do not matter."""
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
