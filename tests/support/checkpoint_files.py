"""Synthetic files in the exact layout of ctallec/world-models, and its formulas in NumPy."""

from itertools import pairwise

import numpy as np
import torch

LATENT, HIDDEN, MIXTURES, ACTIONS = 32, 256, 5, 3
CHANNELS = (3, 32, 64, 128, 256)
ROWS = (2 * LATENT + 1) * MIXTURES + 2
UP = ((5, 1024, 128), (5, 128, 64), (6, 64, 32), (6, 32, 3))


def random_weights(seed=1):
    """Weights of its three models by their names, as float32 arrays."""
    random = np.random.default_rng(seed)
    vae, rnn, controller = {}, {}, {}

    def add(weights, name, *shape, scale):
        weights[f"{name}.weight"] = random.normal(0, scale, shape).astype(np.float32)

    def bias(weights, name, size, scale=0.1):
        weights[f"{name}.bias"] = random.normal(0, scale, size).astype(np.float32)

    for index, (before, after) in enumerate(pairwise(CHANNELS), 1):
        add(vae, f"encoder.conv{index}", after, before, 4, 4, scale=(8 * before) ** -0.5)
        bias(vae, f"encoder.conv{index}", after)
    for name in ("fc_mu", "fc_logsigma"):
        add(vae, f"encoder.{name}", LATENT, 1024, scale=1024**-0.5)
        bias(vae, f"encoder.{name}", LATENT)
    add(vae, "decoder.fc1", 1024, LATENT, scale=0.2)
    bias(vae, "decoder.fc1", 1024)
    for index, (size, before, after) in enumerate(UP, 1):
        add(vae, f"decoder.deconv{index}", before, after, size, size, scale=(2 * before) ** -0.5)
        bias(vae, f"decoder.deconv{index}", after)
    add(rnn, "gmm_linear", ROWS, HIDDEN, scale=0.1)
    bias(rnn, "gmm_linear", ROWS)
    for name, shape in (("weight_ih", (4 * HIDDEN, ACTIONS + LATENT)), ("weight_hh", (4 * HIDDEN, HIDDEN))):
        rnn[f"rnn.{name}_l0"] = random.normal(0, 0.1, shape).astype(np.float32)
    for name in ("bias_ih", "bias_hh"):
        rnn[f"rnn.{name}_l0"] = random.normal(0, 0.1, 4 * HIDDEN).astype(np.float32)
    add(controller, "fc", ACTIONS, LATENT + HIDDEN, scale=0.2)
    bias(controller, "fc", ACTIONS)
    return vae, rnn, controller


def write_checkpoints(folder, weights, *, legacy=False, with_reward=True):
    """Write `vae/best.tar`, `mdrnn/best.tar` and `ctrl/best.tar` as its programs save them."""
    vae, rnn, controller = (as_state(each) for each in weights)
    squares = torch.rand(ROWS, HIDDEN)
    if not with_reward:
        squares[-2] = 0
    optimiser = {"state": {0: {"step": 7, "square_avg": squares}}, "param_groups": [{"lr": 1e-3, "params": [0]}]}
    stopping = {"mode": "min", "best": float("inf"), "num_bad_epochs": 0}
    trained = {"scheduler": stopping, "earlystopping": stopping, "precision": 33.5, "epoch": 9}
    files = {
        "vae": {"state_dict": vae, "optimizer": optimiser, **trained},
        "mdrnn": {"state_dict": rnn, "optimizer": optimiser, **trained},
        "ctrl": {"epoch": 2, "reward": np.float64(861.5), "state_dict": controller},
    }
    for part, content in files.items():
        (folder / part).mkdir(parents=True, exist_ok=True)
        torch.save(content, folder / part / "best.tar", _use_new_zipfile_serialization=not legacy)


def as_state(weights):
    """A state_dict as a module has it, with its metadata."""
    module = torch.nn.ParameterDict()
    state = type(module.state_dict())((name, torch.from_numpy(array)) for name, array in weights.items())
    state._metadata = {"": {"version": 1}}
    return state


def sigmoid(value):
    return 1 / (1 + np.exp(-value))


def encode(vae, picture):
    """The mean latent of a picture `(64, 64, 3)`, in double precision."""
    value = picture.astype(np.float64).transpose(2, 0, 1) / 255
    for index in range(1, 5):
        weight, bias = vae[f"encoder.conv{index}.weight"].astype(float), vae[f"encoder.conv{index}.bias"]
        side = (value.shape[1] - 4) // 2 + 1
        spots = [(2 * row, 2 * column) for row in range(side) for column in range(side)]
        patches = np.stack([value[:, row : row + 4, column : column + 4] for row, column in spots])
        value = np.maximum(np.tensordot(patches, weight, ([1, 2, 3], [1, 2, 3])) + bias, 0)
        value = value.T.reshape(-1, side, side)
    return vae["encoder.fc_mu.weight"].astype(float) @ value.ravel() + vae["encoder.fc_mu.bias"]


def decode(vae, latent):
    """The picture `(64, 64, 3)` of a latent, from 0 to 1."""
    value = np.maximum(vae["decoder.fc1.weight"].astype(float) @ latent + vae["decoder.fc1.bias"], 0)[:, None, None]
    for index, (size, _, outputs) in enumerate(UP, 1):
        weight, bias = vae[f"decoder.deconv{index}.weight"].astype(float), vae[f"decoder.deconv{index}.bias"]
        side = value.shape[1]
        out = np.zeros((outputs, 2 * (side - 1) + size, 2 * (side - 1) + size)) + bias[:, None, None]
        for row in range(side):
            for column in range(side):
                spot = np.tensordot(value[:, row, column], weight, 1)
                out[:, 2 * row : 2 * row + size, 2 * column : 2 * column + size] += spot
        value = np.maximum(out, 0) if index < len(UP) else sigmoid(out)
    return value.transpose(1, 2, 0)


class Memory:
    """Its LSTM and heads, in double precision."""

    def __init__(self, rnn):
        self._rnn = {name: array.astype(float) for name, array in rnn.items()}
        self.hidden = self.cell = np.zeros(HIDDEN)

    def advance(self, action, latent):
        rnn = self._rnn
        gates = rnn["rnn.weight_ih_l0"] @ np.concatenate([action, latent]) + rnn["rnn.bias_ih_l0"]
        gates = gates + rnn["rnn.weight_hh_l0"] @ self.hidden + rnn["rnn.bias_hh_l0"]
        enter, forget, candidate, leave = np.split(gates, 4)
        self.cell = sigmoid(forget) * self.cell + sigmoid(enter) * np.tanh(candidate)
        self.hidden = sigmoid(leave) * np.tanh(self.cell)
        out = rnn["gmm_linear.weight"] @ self.hidden + rnn["gmm_linear.bias"]
        width = MIXTURES * LATENT
        means, spreads = (out[at : at + width].reshape(MIXTURES, LATENT) for at in (0, width))
        return means, np.exp(spreads), out[2 * width : 2 * width + MIXTURES], out[-2], out[-1]


def drive(weights, pictures):
    """The actions `(T, 3)` of its controller on pictures `(T, 64, 64, 3)`; the environment limits them."""
    vae, rnn, controller = weights
    memory, actions = Memory(rnn), []
    for picture in pictures:
        latent = encode(vae, picture)
        features = np.concatenate([latent, memory.hidden])
        action = controller["fc.weight"].astype(float) @ features + controller["fc.bias"]
        memory.advance(action, latent)
        actions.append(action)
    return np.array(actions)
