"""World models with random weights."""

import io
from dataclasses import replace

import numpy as np
import torch

from dreamfleet.common.artifacts.bundle import (
    DECODER,
    DREAM_GRAPH,
    ENCODER,
    INITIAL_LATENTS_PART,
    RECORDED_STATES,
    BundleManifest,
    write_bundle,
)
from dreamfleet.common.serialization.optional_fields import to_dict
from dreamfleet.worker.training.assemble import export_graphs, make_manifest
from dreamfleet.worker.worldmodel.export import export_decoder, export_dream, export_encoder
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN
from dreamfleet.worker.worldmodel.mdnrnn_config import REWARDED
from dreamfleet.worker.worldmodel.vae import VAE
from dreamfleet.worker.worldmodel.vae_config import PAPER


def random_models(seed=0, vae=PAPER, rnn=REWARDED):
    torch.manual_seed(seed)
    models = VAE(vae), MDNRNN(rnn)
    for name, values in models[0].state_dict().items():
        if "running" in name:  # as after training
            values.uniform_(0.5, 1.5)
    return models[0].eval(), models[1].eval()


def npy(array):
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def weights(model):
    return {name: tensor.detach().numpy() for name, tensor in model.state_dict().items()}


def states(count, vae=PAPER, rnn=REWARDED, seed=0):
    """So many made-up recorded states, as a bundle holds them."""
    return np.random.default_rng(seed).uniform(-1, 1, (count, 2 * vae.latent + rnn.state)).astype(np.float16)


def write_random_bundle(path, seed=0, vae=PAPER, rnn=REWARDED, initial=None, recorded=None):
    models = [weights(each) for each in random_models(seed, vae, rnn)]
    if initial is None:
        initial = np.random.default_rng(seed).normal(size=(4, 2, vae.latent)).astype(np.float32)
    parts = export_graphs(*models, initial, vae, rnn)
    if recorded is not None:
        parts[RECORDED_STATES] = npy(recorded)
    return write_bundle(path, make_manifest("random", {"seed": seed}, vae, rnn), parts)


def write_world_bundle(
    path, facts, task="tests.support.pixel_world:DodgeTask", seed=0, vae=PAPER, rnn=REWARDED, recorded=None,
    preprocessing="box-64",
):  # fmt: skip
    """A bundle of a world that its manifest describes by `facts`; its MDN-RNN takes the world's actions."""
    rnn = replace(rnn, actions=facts.actions.actions)
    vae_weights, rnn_weights = (weights(each) for each in random_models(seed, vae, rnn))
    initial = np.random.default_rng(seed).normal(size=(4, 2, vae.latent)).astype(np.float32)
    parts = {
        ENCODER: export_encoder(vae_weights, vae), DECODER: export_decoder(vae_weights, vae),
        DREAM_GRAPH: export_dream(rnn_weights, rnn), INITIAL_LATENTS_PART: npy(initial),
    }  # fmt: skip
    if recorded is not None:
        parts[RECORDED_STATES] = npy(recorded)
    manifest = BundleManifest(
        "random", task, preprocessing, (vae.picture, vae.picture, 3), vae.latent, rnn.hidden, rnn.actions,
        provenance={"seed": seed}, models={"vae": to_dict(vae), "mdnrnn": to_dict(rnn)}, world=facts,
    )  # fmt: skip
    return write_bundle(path, manifest, parts)
