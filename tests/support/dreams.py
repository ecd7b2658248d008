"""Random world models of worlds: CarRacing, one of three choices, one of a single number, and one of three numbers."""

import dataclasses

import numpy as np

from dreamfleet.common.artifacts.actions import Continuous, grouped, one_hot
from dreamfleet.common.artifacts.bundle import DREAM_GRAPH, write_bundle
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts, WorldFacts
from dreamfleet.worker.worldmodel.export import export_dream
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import random_rnn_weights, write_random_bundle, write_world_bundle

VAE = VAEConfig(latent=3, channels=(2, 2, 2, 2))
ABOUT = {"packages": ("numpy", "onnxruntime"), "horizon": 200, "frames_per_second": 10}
DRAWN = EndRule("drawn", odds_weight=30.0)  # untrained heads predict an end at every second step
WORLDS = {
    "car-racing": None,
    "choices": WorldFacts.of(one_hot(3), reward=RewardFacts("survival", gain=4.0), end=DRAWN, **ABOUT),
    "one number": WorldFacts.of(Continuous.between([-1], [1]), reward=RewardFacts("value"), end=DRAWN, **ABOUT),
    "groups": WorldFacts.of(grouped([3, 2, 5], bits=[1]), reward=RewardFacts("survival"), end=DRAWN, **ABOUT),
}
MODELS = {
    "car-racing": MDNRNNConfig(latent=3, hidden=4),
    "choices": MDNRNNConfig(latent=3, hidden=4, done=True, reward="none"),
    "one number": MDNRNNConfig(latent=3, hidden=4, done=True, reward="value"),
    "groups": MDNRNNConfig(latent=3, hidden=4, done=True, reward="none"),
}
ACTIONS = {
    "car-racing": np.array([0.1, 0.5, 0.0], np.float32),
    "choices": np.int64(2),
    "one number": np.array([-0.3], np.float32),
    "groups": np.array([2, 0, 4]),
}


def write_bundle_of(world, path, recorded=None, **options):
    """A random bundle of one of the worlds."""
    if WORLDS[world] is None:
        return write_random_bundle(path, vae=VAE, rnn=MODELS[world], recorded=recorded)
    return write_world_bundle(path, WORLDS[world], vae=VAE, rnn=MODELS[world], recorded=recorded, **options)


def with_end(bundle, path, probability, **facts):
    """The bundle with a model that predicts the end with this probability at every step, and changed facts."""
    rnn = MDNRNNConfig(**bundle.manifest.models["mdnrnn"])
    weights = random_rnn_weights(0, rnn)
    weights["heads.weight"][-1] = 0.0
    weights["heads.bias"][-1] = np.log(probability / (1 - probability))
    parts = {name: bundle.read(name) for name in bundle.manifest.parts}
    manifest = dataclasses.replace(bundle.manifest, world=dataclasses.replace(bundle.manifest.world, **facts))
    return write_bundle(path, manifest, {**parts, DREAM_GRAPH: export_dream(weights, rnn)})
