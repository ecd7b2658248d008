"""A world model with random weights: everything but knowledge."""

import numpy as np
import torch

from common.bundle import write_bundle
from worker.training.assemble import graphs, manifest
from worker.worldmodel.mdnrnn import MDNRNN, MDNRNNConfig
from worker.worldmodel.vae import VAE, VAEConfig


def random_models(seed=0):
    torch.manual_seed(seed)
    return VAE(VAEConfig()), MDNRNN(MDNRNNConfig())


def weights(model):
    return {name: tensor.detach().numpy() for name, tensor in model.state_dict().items()}


def write_random_bundle(path, seed=0):
    vae, rnn = random_models(seed)
    initial = np.random.default_rng(seed).normal(size=(4, 2, 32)).astype(np.float32)
    return write_bundle(path, manifest("random", {"seed": seed}), graphs(weights(vae), weights(rnn), initial))
