"""Named amounts of everything that training does."""

from __future__ import annotations

from dataclasses import dataclass

from common.errors import UsageError
from worker.training.collect import CollectConfig


@dataclass(frozen=True)
class TrainConfig:
    """One model's training: Adam at `rate`, `updates` of `batch` pictures or episodes, gradients clipped at `clip`."""

    updates: int
    batch: int
    rate: float
    clip: float = 1.0
    seed: int = 0


@dataclass(frozen=True)
class Preset:
    """A whole pipeline."""

    name: str
    collect: CollectConfig
    vae: TrainConfig
    mdnrnn: TrainConfig


# About 25 minutes of two cores: 4 of driving, 12 of VAE, 8 of MDN-RNN.
TINY = Preset(
    name="tiny",
    collect=CollectConfig(episodes=1200, steps=300),
    vae=TrainConfig(updates=2800, batch=100, rate=5e-4),
    mdnrnn=TrainConfig(updates=1600, batch=32, rate=1e-3),
)
PRESETS = {preset.name: preset for preset in (TINY,)}


def find_preset(name: str) -> Preset:
    """The preset of that name; `UsageError` lists those that exist."""
    if name not in PRESETS:
        raise UsageError(f"unknown preset {name!r}: choose one of {', '.join(sorted(PRESETS))}")
    return PRESETS[name]
