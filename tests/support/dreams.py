"""Random world models of worlds: CarRacing, one of three choices, one of a single number, and one of three numbers."""

import dataclasses

import numpy as np

from dreamfleet.common.artifacts.actions import Continuous, grouped, one_hot
from dreamfleet.common.artifacts.bundle import DREAM_GRAPH, write_bundle
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts, WorldFacts
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.dream.environment import Dream
from dreamfleet.worker.tasks.api import Score
from dreamfleet.worker.worldmodel.export import export_dream
from dreamfleet.worker.worldmodel.inference import Controllers, DreamStep
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


def spec_of(bundle, horizon, **more):
    """The specification of a run in the bundle's dream."""
    return TaskSpec("dream", bundle.sha256, horizon, 0, **more)


class DreamPolicy:
    """A controller in a dream environment: it observes latents, and its memory advances as the dream's does."""

    def __init__(self, bundle):
        self._controllers, self._step = Controllers(bundle), DreamStep(bundle)

    def begin(self, parameters):
        """Start an episode with a controller's flat parameter vector `(size,)`."""
        self._parameters = parameters.astype(np.float32).reshape(1, -1)
        self._state = self._step.zero_state(1)

    def set_memory(self, memory):
        """Start with the model's memory `(memory,)`; an environment's `reset` returns it in `info`."""
        self._state[:, : self._step.memory_size] = memory

    def act(self, observation):
        """The action `(actions,)` for a latent `(latent,)`."""
        latent = observation[None]
        action = self._controllers.act(self._parameters, latent, self._state)
        self._state = self._step.advance(latent, action, self._state)
        return action[0]


def dreamt(environment, policy, vector, seed):
    """The score of a dream step by step."""
    latent, info = environment.reset(seed=seed)
    policy.begin(vector)
    policy.set_memory(info["memory"])
    fitness, steps, over = 0.0, 0, False
    while not over:
        latent, reward, done, truncated, _ = environment.step(policy.act(latent))
        fitness, steps, over = fitness + reward, steps + 1, done or truncated
    return Score(fitness, steps)


def dreams_of(bundle, candidates, seeds):
    """Random candidates, each with these seeds."""
    random = np.random.default_rng(4)
    vectors = [random.normal(0, 0.3, bundle.controller_shape.size).astype(np.float32) for _ in range(candidates)]
    return [(vector, seed) for vector in vectors for seed in seeds]


def same_bits(bundle, spec, dreams):
    """The scores of dreams, which are the same together, in any order, in part, alone and step by step."""
    batch, temperature = DreamBatch(bundle, spec), spec.temperature or 1.0
    together = batch.score(dreams)
    assert batch.score(dreams[::-1])[::-1] == together
    assert DreamBatch(bundle, spec).score(dreams[5:12]) == together[5:12]
    assert [batch.score([dream])[0] for dream in dreams] == together
    environment = Dream(bundle, temperature=temperature, horizon=spec.horizon, recorded=spec.recorded)
    policy = DreamPolicy(bundle)
    assert [dreamt(environment, policy, *dream) for dream in dreams[:8]] == together[:8]
    return together
