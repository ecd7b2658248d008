"""Synthetic files in the exact layout of ctallec/world-models, and its models in double precision."""

from itertools import pairwise

import numpy as np
import torch
from torch import nn

LATENT, HIDDEN, MIXTURES, ACTIONS = 32, 256, 5, 3
CHANNELS = (3, 32, 64, 128, 256)
ROWS = (2 * LATENT + 1) * MIXTURES + 2
UP = ((5, 1024, 128), (5, 128, 64), (6, 64, 32), (6, 32, 3))
GAIN = 3  # of the weights with which torch begins: pictures and actions differ clearly


def models():
    """Its VAE, MDN-RNN and controller, with its names."""
    down = {f"conv{index}": nn.Conv2d(*each, 4, stride=2) for index, each in enumerate(pairwise(CHANNELS), 1)}
    up = {f"deconv{index}": nn.ConvTranspose2d(*each, size, stride=2) for index, (size, *each) in enumerate(UP, 1)}
    latents = {name: nn.Linear(1024, LATENT) for name in ("fc_mu", "fc_logsigma")}
    parts = {"encoder": down | latents, "decoder": {"fc1": nn.Linear(LATENT, 1024), **up}}
    vae = nn.ModuleDict({name: nn.ModuleDict(layers) for name, layers in parts.items()})
    rnn = nn.ModuleDict({"gmm_linear": nn.Linear(HIDDEN, ROWS), "rnn": nn.LSTM(ACTIONS + LATENT, HIDDEN)})
    return vae, rnn, nn.ModuleDict({"fc": nn.Linear(LATENT + HIDDEN, ACTIONS)})


def random_weights(seed=1):
    """Weights of its three models by their names, as float32 arrays."""
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(seed)
        states = [model.state_dict() for model in models()]
    return tuple({name: GAIN * value.numpy() for name, value in each.items()} for each in states)


def with_weights(number, weights):
    """One of the models in double precision."""
    model = models()[number].requires_grad_(False)
    model.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()})
    return model.double()


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
    module = nn.ParameterDict()
    state = type(module.state_dict())((name, torch.from_numpy(array)) for name, array in weights.items())
    state._metadata = {"": {"version": 1}}
    return state


def sigmoid(value):
    return 1 / (1 + np.exp(-value))


def decode(vae, latent):
    """The picture `(64, 64, 3)` of a latent, from 0 to 1."""
    decoder = with_weights(0, vae)["decoder"]
    value = decoder["fc1"](torch.from_numpy(latent))[None, :, None, None]
    for index in range(1, len(UP) + 1):
        value = decoder[f"deconv{index}"](value.relu())
    return value[0].sigmoid().permute(1, 2, 0).numpy()


class Memory:
    """Its LSTM and heads."""

    def __init__(self, rnn):
        self._model, self._state = with_weights(1, rnn), None
        self.hidden = torch.zeros(HIDDEN, dtype=torch.float64)

    def advance(self, action, latent):
        seen = torch.cat([torch.as_tensor(action), torch.as_tensor(latent)])[None]
        (self.hidden,), self._state = self._model["rnn"](seen, self._state)
        out, width = self._model["gmm_linear"](self.hidden).numpy(), MIXTURES * LATENT
        means, spreads = (out[at : at + width].reshape(MIXTURES, LATENT) for at in (0, width))
        return means, np.exp(spreads), out[2 * width : 2 * width + MIXTURES], out[-2], out[-1]


def drive(weights, pictures):
    """The actions `(T, 3)` of its controller on pictures `(T, 64, 64, 3)`; the environment limits them."""
    encoder, memory, controller = (
        with_weights(0, weights[0])["encoder"],
        Memory(weights[1]),
        with_weights(2, weights[2]),
    )
    actions = []
    for picture in torch.from_numpy(pictures).double().permute(0, 3, 1, 2) / 255:
        value = picture
        for index in range(1, len(CHANNELS)):
            value = encoder[f"conv{index}"](value).relu()
        latent = encoder["fc_mu"](value.flatten())
        actions.append(controller["fc"](torch.cat([latent, memory.hidden])))
        memory.advance(actions[-1], latent)
    return torch.stack(actions).numpy()


def write_drive(folder, number, steps=6, size=64):
    """One of its drives: each picture is the one after its action, and actions are drawn in advance."""
    random = np.random.default_rng(number)
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {
        "observations": random.integers(0, 256, (steps, size, size, 3), dtype=np.uint8),
        "rewards": random.random(steps),
        "actions": random.random((steps + 4, 3)),
        "terminals": np.arange(steps) == steps - 1,
    }
    np.savez(folder / f"rollout_{number}.npz", **arrays)
    return arrays
