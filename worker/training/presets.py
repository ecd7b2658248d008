"""Named amounts of everything that training does, and the models it is done to."""

from __future__ import annotations

from dataclasses import dataclass

from dreamfleet.common.cli.presets import check_preset
from dreamfleet.worker.training.data.collect_config import CollectConfig
from dreamfleet.worker.training.train_config import TrainConfig
from dreamfleet.worker.worldmodel import mdnrnn_config, vae_config
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig


@dataclass(frozen=True)
class TrainingPreset:
    """A whole pipeline."""

    name: str
    collect: CollectConfig
    vae: TrainConfig
    mdnrnn: TrainConfig
    vae_layers: VAEConfig = vae_config.PAPER
    mdnrnn_layers: MDNRNNConfig = mdnrnn_config.REWARDED


# About 12 minutes of two cores. A VAE that was trained on more, or longer, told pictures apart better and made worse
# dreams; an MDN-RNN that was made better ones (docs/dreams.md): `iterate` goes on with it and the decoder alone.
TINY = TrainingPreset(
    name="tiny",
    collect=CollectConfig(episodes=620, steps=300),
    vae=TrainConfig(updates=1500, batch=100, rate=5e-4, clip=0),
    mdnrnn=TrainConfig(updates=800, batch=32, rate=1e-3),
)
# As the sources have it: ten passes over the frames for the VAE at 1e-4, rollouts from the track's beginning that end
# with their steps, and gradients and trainings that nothing cuts short.
NOTEBOOK = TrainingPreset(
    name="notebook",
    collect=CollectConfig(episodes=1000, steps=300, picture=96, driver="uniform", anywhere=0.0, patience=0),
    vae=TrainConfig(updates=30_000, batch=100, rate=1e-4, clip=0),
    mdnrnn=TrainConfig(updates=10_000, batch=100, rate=1e-3, clip=0),
    vae_layers=vae_config.NOTEBOOK,
    mdnrnn_layers=mdnrnn_config.NOTEBOOK,
)
ARTICLE = TrainingPreset(
    name="article",
    collect=CollectConfig(episodes=2000, steps=300, driver="pushed", anywhere=0.0, patience=0),
    vae=TrainConfig(updates=60_000, batch=100, rate=1e-4, clip=0),
    mdnrnn=TrainConfig(updates=4000, batch=100, rate=1e-3, clip=0),
    vae_layers=vae_config.ARTICLE,
    mdnrnn_layers=mdnrnn_config.ARTICLE,
)
# Plain and attentive compare at equal parameters: `--window 0 --hidden 256` is the plain one.
ATTENTIVE = TrainingPreset(
    name="attentive",
    collect=CollectConfig(episodes=500, steps=384),
    vae=TrainConfig(updates=19_200, batch=100, rate=1e-3, patience=10, clip=0),
    mdnrnn=TrainConfig(updates=4000, batch=100, rate=1e-3, patience=10),
    mdnrnn_layers=mdnrnn_config.ATTENTIVE,
)
PAPER = TrainingPreset(
    name="paper",
    collect=CollectConfig(episodes=10_000, steps=1000, driver="network", anywhere=0.0, patience=0),
    vae=TrainConfig(updates=1_000_000, batch=100, rate=1e-4, patience=10, validate_every=2000, clip=0),
    mdnrnn=TrainConfig(updates=4000, batch=100, rate=1e-3, patience=10),
    mdnrnn_layers=mdnrnn_config.PAPER,
)
PRESETS = {preset.name: preset for preset in (TINY, NOTEBOOK, ARTICLE, ATTENTIVE, PAPER)}


def find_preset(name: str) -> TrainingPreset:
    """The preset of that name; `UsageError` lists those that exist."""
    return PRESETS[check_preset("training", name)]
