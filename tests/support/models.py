"""Models in torch with the weights of `tests.support.bundles`."""

import torch

from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN
from dreamfleet.worker.worldmodel.mdnrnn_config import REWARDED
from dreamfleet.worker.worldmodel.vae import VAE
from dreamfleet.worker.worldmodel.vae_config import PAPER
from tests.support.bundles import random_rnn_weights, random_vae_weights


def random_models(seed=0, vae=PAPER, rnn=REWARDED):
    models = VAE(vae), MDNRNN(rnn)
    for model, values in zip(models, (random_vae_weights(seed, vae), random_rnn_weights(seed, rnn)), strict=True):
        model.load_state_dict({name: torch.from_numpy(value) for name, value in values.items()})
    return models[0].eval(), models[1].eval()


def weights(model):
    return {name: tensor.detach().numpy() for name, tensor in model.state_dict().items()}
