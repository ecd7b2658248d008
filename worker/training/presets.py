"""The presets of whole trainings: amounts of data and updates, and the models' layers.

A row of docs/reference/presets.md each. Pages: sources.md, operations-notes.md.
"""

from dataclasses import dataclass, field
from typing import Annotated, Any, get_type_hints

from msgspec import Meta

from dreamfleet.common.artifacts.driving import FIRST_WORLD
from dreamfleet.common.cli.bounds import NotNegative, Positive, check_bounds
from dreamfleet.common.cli.config import option
from dreamfleet.common.cli.presets import check_preset
from dreamfleet.common.errors import UsageError
from dreamfleet.common.schema.validation import Count
from dreamfleet.common.worlds.shipped import WORLDS
from dreamfleet.worker.training.data.collect_config import CollectConfig
from dreamfleet.worker.worldmodel import mdnrnn_config, vae_config
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig

Seed = Annotated[int, Meta(ge=0, le=2**43)]  # of a training: times a million it is still a seed of torch


def required(text: str) -> Any:
    """A field without a default, with the text that `--help` shows."""
    return field(metadata={"help": text})


@dataclass(frozen=True)
class TrainConfig:
    """How one model is trained: Adam at `rate` for `updates` updates of `batch` pictures or drives."""

    updates: Positive = required("updates in total, those already made included")
    batch: Positive = required("pictures, or drives, per update")
    rate: float = required("Adam's learning rate")
    clip: NotNegative = option(1.0, "largest norm of the gradients; 0: no limit")
    seed: Seed = option(0, "random seed of the training: of first weights, batches and noise")
    decay: float = option(1.0, "factor of the rate per epoch, in which each recorded frame or drive is shown once")
    patience: Count = option(0, "validations without a better held-out loss before training ends; 0: never")
    validate_every: Positive = option(200, "updates between validations on held-out drives, each with a checkpoint")
    keep_every: Count = option(
        0, "updates between checkpoints that are kept beside the last one, as vae.000400.safetensors; 0: none"
    )

    def __post_init__(self) -> None:
        check_bounds(self, are_flags=False)
        if not (self.rate > 0 and 0 < self.decay <= 1):
            raise UsageError(f"rate must be positive, and decay in (0, 1], not {self.rate} and {self.decay}")


@dataclass(frozen=True)
class TrainingPreset:
    """The configuration of a whole pipeline: collecting, both trainings, both models' layers.

    `task` is the task whose world its amounts are of; empty: any world with pictures.
    """

    name: str
    collect: CollectConfig
    vae: TrainConfig
    mdnrnn: TrainConfig
    vae_layers: VAEConfig = vae_config.PAPER
    mdnrnn_layers: MDNRNNConfig = mdnrnn_config.REWARDED
    task: str = FIRST_WORLD


# About 12 minutes on two cores. More data or updates made a VAE distinguish pictures better but dream worse, while an
# MDN-RNN gained from them (docs/explanation/dreams.md): `iterate` continues training the MDN-RNN and the decoder alone.
TINY = TrainingPreset(
    name="tiny",
    collect=CollectConfig(episodes=620, steps=300),
    vae=TrainConfig(updates=1500, batch=100, rate=5e-4, clip=0),
    mdnrnn=TrainConfig(updates=800, batch=32, rate=1e-3),
)
# As in the sources: ten passes over the frames for the VAE at a rate of 1e-4, rollouts from the track's beginning that
# end after `steps`, no gradient clipping and no early stopping.
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
# Compares plain and attentive at equal numbers of parameters: window=0 and hidden=256 is the plain one.
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
# Half of the paper's channels, so that a bundle is small enough to ship. Things of a few pixels, such as a ball, decide
# many games; an error of theirs counts more.
PIXELS = TrainingPreset(
    name="pixels",
    collect=CollectConfig(episodes=400, steps=1000, anywhere=0.0, patience=0),
    vae=TrainConfig(updates=1500, batch=100, rate=1e-3),
    mdnrnn=TrainConfig(updates=500, batch=16, rate=1e-3),
    vae_layers=VAEConfig(channels=(16, 32, 64, 128), pixel_weight=3.0),
    mdnrnn_layers=MDNRNNConfig(reward="value", reward_scale=0, done=True, done_weight=3.0),
    task="",
)


KINDS = get_type_hints(TrainingPreset)
OF_WORLDS = tuple(
    TrainingPreset(name=name, task=world.task, **{part: KINDS[part](**values) for part, values in given.items()})
    for world in WORLDS.values()
    for name, given in world.training_presets.items()
)
PRESETS = {each.name: each for each in (TINY, NOTEBOOK, ARTICLE, ATTENTIVE, PAPER, PIXELS, *OF_WORLDS)}


def find_preset(name: str) -> TrainingPreset:
    """Return the preset `name`; `UsageError` lists those that exist."""
    return PRESETS[check_preset("training", name)]
