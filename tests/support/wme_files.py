"""Files in the exact layout of hardmaru/WorldModelsExperiments, doomrnn, and its formulas in double precision.

The layout is that of its `doomrnn.py`: `ConvVAE` and `Model` write `get_model_params` as JSON, in the order in which
they create their variables. `tf_models/initial_z.json` and `log/doomrnn.cma.16.64.best.json` are public; the latter's
order of inputs is `DoomCoverRNNEnv._current_state`'s, and `model.py` multiplies them by one matrix, without a bias.
"""

import json
from itertools import pairwise

import numpy as np

from tests.support.checkpoint_files import CHANNELS, sigmoid

LATENT, UNITS, MIXTURES = 64, 512, 5
HEADS = 3 * MIXTURES * LATENT + 1


def whole_numbers(random, *shape, scale):
    return np.round(random.normal(0, scale, shape) * 10_000).astype(int)


def vae_of(random, latent):
    """The arrays of a VAE, which are in the same order for both worlds."""
    down = [((4, 4, *channels), channels[1], (16 * channels[0]) ** -0.5) for channels in pairwise(CHANNELS)]
    up = [((5, 5, 128, 1024), 128), ((5, 5, 64, 128), 64), ((6, 6, 32, 64), 32), ((6, 6, 3, 32), 3)]
    layers = [
        *down, *[((1024, latent), latent, 1024**-0.5)] * 2, ((latent, 1024), 1024, 0.2),
        *((weights, biases, weights[-1] ** -0.5) for weights, biases in up),
    ]  # fmt: skip
    return [
        whole_numbers(random, *shape, scale=each)
        for weights, biases, scale in layers
        for shape, each in ((weights, scale), ((biases,), 0.1))
    ]


def encode(vae, picture):
    """The mean latent of a picture as we see it; theirs is that minus 1. `vae` holds the weights themselves."""
    value = (picture - 1.0) / 255
    for layer in range(4):
        weight, offset = vae[2 * layer], vae[2 * layer + 1]
        side = (value.shape[0] - 4) // 2 + 1
        corners = [(2 * row, 2 * column) for row in range(side) for column in range(side)]
        patches = np.stack([value[row : row + 4, column : column + 4] for row, column in corners])
        value = np.maximum(np.tensordot(patches, weight, 3) + offset, 0).reshape(side, side, -1)
    return value.ravel() @ vae[8] + vae[9]


def write_doomrnn(folder):
    """`tf_models/` and a controller of random weights; the arrays of VAE and RNN, and the controller's numbers."""
    random = np.random.default_rng(3)
    vae = vae_of(random, LATENT)
    rnn = [
        whole_numbers(random, LATENT + 2 + UNITS, 4 * UNITS, scale=0.06),
        whole_numbers(random, 4 * UNITS, scale=0.2),
        whole_numbers(random, UNITS, HEADS, scale=0.05),
        whole_numbers(random, HEADS, scale=0.1),
    ]
    rnn[0][LATENT + 1] *= 10  # the first step's input, so that it counts
    first = whole_numbers(random, 2, 1000, LATENT, scale=1.0)
    controller = random.normal(0, 0.05, LATENT + 2 * UNITS)
    (folder / "tf_models").mkdir(parents=True)
    (folder / "log").mkdir()
    for name, arrays in (("vae", vae), ("rnn", rnn), ("initial_z", first)):
        (folder / "tf_models" / f"{name}.json").write_text(json.dumps([each.tolist() for each in arrays]))
    best = folder / "log" / "doomrnn.cma.16.64.best.json"
    best.write_text(json.dumps([controller.round(4).tolist(), 958.505859375]))
    return vae, rnn, controller.round(4)


class Memory:
    """Its LSTM and heads."""

    def __init__(self, rnn):
        self._rnn = [each / 10_000 for each in rnn]
        self.cell, self.hidden, self._restart = np.zeros(UNITS), np.zeros(UNITS), 1.0

    def advance(self, latent, action):
        """The heads: log weights, means, log deviations `(latents, mixtures)`, and the logit of the end."""
        kernel, bias, heads, offsets = self._rnn
        gates = np.concatenate([latent, [action, self._restart], self.hidden]) @ kernel + bias
        enter, candidate, forget, leave = np.split(gates, 4)
        self.cell = self.cell * sigmoid(forget + 1) + sigmoid(enter) * np.tanh(candidate)
        self.hidden = np.tanh(self.cell) * sigmoid(leave)
        self._restart = 0.0
        out = self.hidden @ heads + offsets
        return *out[1:].reshape(LATENT, 3, MIXTURES).transpose(1, 0, 2), out[0]


def drive(vae, rnn, controller, pictures):
    """The outputs `(T,)` of its controller on pictures `(T, 64, 64, 3)`."""
    vae, memory, actions = [each / 10_000 for each in vae], Memory(rnn), []
    for picture in pictures:
        latent = encode(vae, picture)
        actions.append(np.tanh(controller @ np.concatenate([latent, memory.cell, memory.hidden])))
        memory.advance(latent, actions[-1])
    return np.array(actions)
