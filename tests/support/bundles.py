"""World models with random weights."""

import io
import struct
import zipfile
from dataclasses import replace
from math import sqrt

import numpy as np

from dreamfleet.common.artifacts.bundle import (
    DECODER,
    DREAM_GRAPH,
    ENCODER,
    INITIAL_LATENTS_PART,
    LAYERED_CONTROLLER,
    LINEAR_CONTROLLER,
    POLICY,
    RECORDED_STATES,
    BundleManifest,
    write_bundle,
)
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD
from dreamfleet.worker.training.data.dataset import find_world, preprocessing_of_size
from dreamfleet.worker.training.dream_facts import NO_DRIVES, describe_world
from dreamfleet.worker.worldmodel.export import (
    export_controller,
    export_decoder,
    export_dream,
    export_encoder,
    export_policy,
)
from dreamfleet.worker.worldmodel.mdnrnn_config import REWARDED
from dreamfleet.worker.worldmodel.vae_config import PAPER


class RandomWeights(dict):
    """Weights by their names in torch, each uniform within 1 / sqrt(inputs), as torch begins."""

    def __init__(self, seed):
        super().__init__()
        self._random = np.random.default_rng(seed)

    def draw(self, name, shape, inputs):
        self[name] = self._random.uniform(-1, 1, shape).astype(np.float32) / np.float32(sqrt(inputs))

    def add_layer(self, name, shape, inputs, outputs):
        self.draw(f"{name}.weight", shape, inputs)
        self.draw(f"{name}.bias", outputs, inputs)

    def add_dense(self, name, inputs, outputs):
        self.add_layer(name, (outputs, inputs), inputs, outputs)

    def add_norm(self, name, channels):
        """As after training."""
        self[f"{name}.weight"] = np.ones(channels, np.float32)
        self[f"{name}.bias"] = np.zeros(channels, np.float32)
        for running in ("running_mean", "running_var"):
            self[f"{name}.{running}"] = self._random.uniform(0.5, 1.5, channels).astype(np.float32)
        self[f"{name}.num_batches_tracked"] = np.array(1)


def random_vae_weights(seed=0, vae=PAPER):
    weights = RandomWeights(seed)
    for number, layer in enumerate(vae.down):
        name = f"encoder.{number * vae.modules_a_layer}"
        shape = (layer.outputs, layer.inputs, layer.kernel, layer.kernel)
        weights.add_layer(name, shape, layer.inputs * layer.kernel**2, layer.outputs)
        if vae.batch_norm:
            weights.add_norm(f"encoder.{number * vae.modules_a_layer + 1}", layer.outputs)
    first, side = vae.up[0].inputs, vae.decoder_sides[0]
    if vae.columns:
        for name in ("mu", "logvar"):
            inputs = vae.channels[-1]
            weights.add_layer(name, (vae.columns, inputs, side, 3), inputs * side * 3, vae.columns)
        weights.add_layer("dense", (vae.columns, first, side, 3), vae.columns * 3, first)
    else:
        weights.add_dense("mu", vae.flat, vae.latent)
        weights.add_dense("logvar", vae.flat, vae.latent)
        weights.add_dense("dense", vae.latent, first * side**2)
    for number, layer in enumerate(vae.up):
        name = f"decoder.{number * vae.modules_a_layer}"
        shape = (layer.inputs, layer.outputs, layer.kernel, layer.kernel)
        weights.add_layer(name, shape, layer.outputs * layer.kernel**2, layer.outputs)
        if vae.batch_norm and number < len(vae.up) - 1:
            weights.add_norm(f"decoder.{number * vae.modules_a_layer + 1}", layer.outputs)
    return weights


def random_rnn_weights(seed=0, rnn=REWARDED):
    weights = RandomWeights(seed)
    weights.draw("lstm.weight_ih_l0", (4 * rnn.hidden, rnn.lstm_inputs), rnn.hidden)
    weights.draw("lstm.weight_hh_l0", (4 * rnn.hidden, rnn.hidden), rnn.hidden)
    weights.draw("lstm.bias_ih_l0", 4 * rnn.hidden, rnn.hidden)
    weights["lstm.bias_hh_l0"] = np.zeros(4 * rnn.hidden, np.float32)  # one bias as in the sources
    if rnn.columns:
        channels, others = 64, rnn.inputs - rnn.latent + rnn.hidden - rnn.units_in_columns
        seen, outputs = rnn.columns + rnn.column_units, sum(rnn.rows) * rnn.mixtures // rnn.side
        weights.add_layer("heads.near", (channels, seen, 5), seen * 5, channels)
        weights.add_dense("heads.everywhere", others, channels * rnn.side)
        weights.add_layer("heads.second", (channels, channels, 3), channels * 3, channels)
        weights.add_layer("heads.mixtures", (outputs, channels, 1), channels, outputs)
        if rnn.has_reward_head or rnn.done:
            weights.add_dense("heads.others", channels * rnn.side, rnn.has_reward_head + rnn.done)
    else:
        weights.add_dense("heads", rnn.hidden, rnn.outputs)
    if rnn.window:
        weights.add_dense("keys", rnn.latent + rnn.actions, rnn.attention_units)
        weights.draw("query.weight", (rnn.attention_units, rnn.hidden), rnn.hidden)
        weights.draw("score.weight", (1, rnn.attention_units), rnn.attention_units)
    return weights


def npy(array):
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def npy_header(shape, kind="<f4"):
    """The first bytes of an array's file; `shape` is text, and may be none that numpy writes."""
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def parts_of(bundle):
    return {name: bundle.read(name) for name in bundle.manifest.parts}


def rewrite(path, change):
    """Change each member of an archive in its place; one that becomes `None` is left out."""
    with zipfile.ZipFile(path) as archive:
        entries = [(name, archive.read(name)) for name in archive.namelist()]
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in entries:
            if (changed := change(name, data)) is not None:
                archive.writestr(name, changed)


def states(count, vae=PAPER, rnn=REWARDED, seed=0):
    """So many made-up recorded states, as a bundle holds them."""
    return np.random.default_rng(seed).uniform(-1, 1, (count, 2 * vae.latent + rnn.state)).astype(np.float16)


def write_random_bundle(path, seed=0, vae=PAPER, rnn=REWARDED, initial=None, recorded=None):
    """A bundle of CarRacing, with graphs that hold a controller."""
    weights = random_vae_weights(seed, vae), random_rnn_weights(seed, rnn)
    actions = find_world().world.actions
    more = {
        POLICY: export_policy(*weights, vae, rnn, actions),
        LINEAR_CONTROLLER: export_controller(actions, hidden=False),
        LAYERED_CONTROLLER: export_controller(actions, hidden=True),
    }
    pictures, facts = preprocessing_of_size(vae.picture).name, describe_world(OF_FIRST_WORLD, NO_DRIVES, rnn)
    return _write(path, "car-racing", pictures, seed, vae, rnn, weights, initial, recorded, facts, more)


def write_world_bundle(
    path, facts, task="tests.support.pixel_world:DodgeTask", seed=0, vae=PAPER, rnn=REWARDED, recorded=None,
    preprocessing="box-64",
):  # fmt: skip
    """A bundle of a world that its manifest describes by `facts`; its MDN-RNN takes the world's actions."""
    rnn = replace(rnn, actions=facts.actions.actions)
    weights = random_vae_weights(seed, vae), random_rnn_weights(seed, rnn)
    return _write(path, task, preprocessing, seed, vae, rnn, weights, None, recorded, facts)


def _write(path, task, preprocessing, seed, vae, rnn, weights, initial, recorded, facts, more=()):
    if initial is None:
        initial = np.random.default_rng(seed).normal(size=(4, 2, vae.latent)).astype(np.float32)
    parts = {
        ENCODER: export_encoder(weights[0], vae), DECODER: export_decoder(weights[0], vae),
        DREAM_GRAPH: export_dream(weights[1], rnn), INITIAL_LATENTS_PART: npy(initial), **dict(more),
    }  # fmt: skip
    if recorded is not None:
        parts[RECORDED_STATES] = npy(recorded)
    manifest = BundleManifest(
        "random", task, preprocessing, (vae.picture, vae.picture, 3), vae.latent, rnn.hidden, rnn.actions, facts,
        provenance={"seed": seed}, models={"vae": to_plain(vae), "mdnrnn": to_plain(rnn)},
    )  # fmt: skip
    return write_bundle(path, manifest, parts)
