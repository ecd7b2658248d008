"""World models and controllers of ctallec/world-models: `vae/best.tar`, `mdrnn/best.tar` and `ctrl/best.tar`.

Files of `torch.save` are read by torch's reader of weights: it calls nothing that a file names.

Its LSTM takes the action before the latent, its encoder gives the log deviation, its mixture has one weight for all
latents, and its controller's outputs are the action. A bundle says the rest: the layers, the pictures and the heads.
Pages: decisions.md.
"""

import codecs
import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.files.archives import ArchiveLimits, DamagedArchiveError, open_archive
from dreamfleet.common.files.regular_files import read_regular
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.printable import one_line
from dreamfleet.worker.addons.importing.json_weights import Weights, check_range
from dreamfleet.worker.addons.importing.sources import CONTROLLER, MDRNN, VAE
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig

SOURCE = "ctallec/world-models"
ACTIONS = 3
PICTURES = "whole-64"
T = TypeVar("T")
LIMITS = ArchiveLimits(512 << 20, members=4096, zip64=True)  # a VAE with its optimiser's state has 52 MB and 80 members
ZIP_MARK = b"PK\3\4"
_SCALAR: Any = np.dtype(float).type(0).__reduce__()[0]
# NumPy's numbers, which stand beside the weights: a score, for example. NumPy 1 called their module otherwise.
NUMBERS = [
    _SCALAR, (_SCALAR, "numpy.core.multiarray.scalar"), (_SCALAR, "numpy._core.multiarray.scalar"),
    (codecs.encode, "_codecs.encode"), np.dtype, *(type(np.dtype(kind)) for kind in ("f4", "f8", "i4", "i8")),
]  # fmt: skip
_REFUSED = re.compile(r"GLOBAL (\S+)")


class _Checkpoint:
    """A file of this program, and the tensors of its `state_dict`; `DatasetError` if it has none.

    `path`, `content`: what it is and holds. An LSTM's tensors have the names of a cell's.
    """

    def __init__(self, path: Path, needed: str = "", what: str = "") -> None:
        """`needed` is a tensor of a checkpoint of `what`."""
        self.path, self.content = path, read_torch_file(path)
        state = self.content.get("state_dict") if isinstance(self.content, Mapping) else None
        pairs: list[tuple[Any, Any]] = list(state.items()) if isinstance(state, dict) else [(None, None)]
        if not all(isinstance(name, str) and isinstance(each, torch.Tensor) for name, each in pairs):
            raise DatasetError(f"{path} holds no state_dict of tensors: it is no checkpoint of {SOURCE}")
        self.tensors: dict[str, torch.Tensor] = {name.removesuffix("_l0"): tensor for name, tensor in pairs}
        if needed and needed not in self.tensors:
            raise DatasetError(f"{path} holds no {needed}: it is not {what} of {SOURCE}")

    def axes(self, name: str) -> tuple[int, int]:
        """The sizes of a matrix."""
        shape = tuple(self.tensors[name].shape) if name in self.tensors else ()
        if len(shape) != 2:
            raise DatasetError(f"{self.path}: {name} must have two axes, not {shape}")
        return shape[0], shape[1]

    def layer(self, theirs: str, ours: str, shape: tuple[int, ...], outputs: int) -> Weights:
        """The weight, of this shape, and the bias of a layer, under our name."""
        weight, bias = self.array(f"{theirs}.weight", shape), self.array(f"{theirs}.bias", (outputs,))
        return {f"{ours}.weight": weight, f"{ours}.bias": bias}

    def array(self, name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """A tensor of this shape as numbers."""
        tensor = self.tensors.get(name)
        if tensor is None or tensor.shape != shape:
            found = "is missing" if tensor is None else f"has the shape {tuple(tensor.shape)}"
            raise DatasetError(f"{self.path}: {name} {found}, and {SOURCE} has {shape} there")
        if not tensor.is_floating_point():
            raise DatasetError(f"{self.path}: {name} is of type {tensor.dtype}, not of floating-point numbers")
        return check_range(f"{self.path}: {name}", array_of(tensor, self.path))

    def configure(self, kind: type[T], **values: Any) -> T:
        """A configuration of these values."""
        try:
            return kind(**values)
        except UsageError as error:
            raise DatasetError(f"{self.path}: {error}") from error


def read_vae(path: Path) -> tuple[Weights, VAEConfig]:
    """The VAE of a checkpoint, with torch's names, and its layers; `DatasetError` for other layers."""
    checkpoint = _Checkpoint(path, "encoder.fc_mu.weight", "the VAE")
    latent, _ = checkpoint.axes("encoder.fc_mu.weight")
    config = checkpoint.configure(VAEConfig, latent=latent, activate_dense=True)
    weights: Weights = {}
    for part, layers, theirs in (("encoder", config.down, "conv"), ("decoder", config.up, "deconv")):
        for index, layer in enumerate(layers):
            ends = (layer.outputs, layer.inputs) if part == "encoder" else (layer.inputs, layer.outputs)
            name, ours = f"{part}.{theirs}{index + 1}", f"{part}.{index * config.modules_a_layer}"
            weights |= checkpoint.layer(name, ours, (*ends, layer.kernel, layer.kernel), layer.outputs)
    weights |= checkpoint.layer("encoder.fc_mu", "mu", (latent, config.flat), latent)
    spread = checkpoint.layer("encoder.fc_logsigma", "logvar", (latent, config.flat), latent)
    weights |= {name: 2 * array for name, array in spread.items()}  # the log of a variance
    first = config.up[0].inputs
    return weights | checkpoint.layer("decoder.fc1", "dense", (first, latent), first), config


def read_mdnrnn(path: Path) -> tuple[Weights, MDNRNNConfig]:
    """The MDN-RNN of a checkpoint, with torch's names, and its layers; `DatasetError` for other layers.

    Its reward head was trained only with `--include_reward`; without, its weights never had a gradient, as the
    optimiser's state in the file says. The model then has no such head.
    """
    checkpoint = _Checkpoint(path, "gmm_linear.weight", "the MDN-RNN")
    rows, hidden = checkpoint.axes("gmm_linear.weight")
    latent = checkpoint.axes("rnn.weight_ih")[1] - ACTIONS
    mixtures, rest = divmod(rows - 2, 2 * latent + 1) if latent > 0 else (0, 1)
    if rest or mixtures < 1:
        raise DatasetError(f"{path}: {rows} outputs are no mixture of {latent} latents with a reward and an end")
    reward = "none" if _is_reward_untrained(checkpoint, (rows, hidden)) else "value"
    config = checkpoint.configure(
        MDNRNNConfig, latent=latent, hidden=hidden, mixtures=mixtures, reward=reward, done=True, joint=True
    )
    order = _heads_order(config)
    weights = {
        name: array[order] for name, array in checkpoint.layer("gmm_linear", "heads", (rows, hidden), rows).items()
    }
    inputs = np.r_[ACTIONS : ACTIONS + latent, :ACTIONS]  # theirs: action, latent
    kernel = checkpoint.array("rnn.weight_ih", (4 * hidden, latent + ACTIONS))
    weights["lstm.weight_ih_l0"] = np.ascontiguousarray(kernel[:, inputs])
    weights["lstm.weight_hh_l0"] = checkpoint.array("rnn.weight_hh", (4 * hidden, hidden))
    biases = (checkpoint.array(f"rnn.{name}", (4 * hidden,)) for name in ("bias_ih", "bias_hh"))
    weights["lstm.bias_ih_l0"] = np.add(*biases)  # ours has one bias
    weights["lstm.bias_hh_l0"] = np.zeros(4 * hidden, np.float32)
    return weights, config


def read_controller(path: Path) -> NDArray[np.float32]:
    """The parameters `(size,)` of a checkpoint's controller: weights (actions, latent + hidden), then biases."""
    checkpoint = _Checkpoint(path)
    if "fc.weight" not in checkpoint.tensors:
        raise DatasetError(f"{path} holds no controller, but a part of a world model: {world_command(path)} reads both")
    outputs, inputs = checkpoint.axes("fc.weight")
    if outputs != ACTIONS:
        raise DatasetError(f"{path}: its controller has {outputs} outputs, and {SOURCE} has {ACTIONS}")
    layer = checkpoint.layer("fc", "fc", (outputs, inputs), outputs)
    return np.concatenate([layer["fc.weight"].ravel(), layer["fc.bias"]])


def read_torch_file(path: Path) -> Any:
    """What a file of `torch.save` holds; `DatasetError` if it is none, is too large, or holds more than numbers."""
    try:
        data = read_regular(path, LIMITS.size)
        if data.startswith(ZIP_MARK):
            with open_archive(io.BytesIO(data), LIMITS) as archive:  # it may be larger when torch unpacks it
                if not any(name.endswith("data.pkl") for name in archive.names):
                    raise DamagedArchiveError("it is a zip without the data.pkl of torch.save")
        with torch.serialization.safe_globals(NUMBERS):
            return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise DatasetError(f"no file at {path}") from None
    except Exception as error:  # whatever torch meets in a damaged file
        if named := _REFUSED.search(str(error)):
            what = f"it names {named[1][:80]}, which no checkpoint of numbers holds. Nothing was executed"
            raise DatasetError(f"{path} was not read: {what}") from error
        reason = one_line(str(error))[:200]
        raise DatasetError(f"{path} is no file of torch.save that can be read ({reason})") from error


def array_of(tensor: torch.Tensor, path: Path) -> NDArray[np.float32]:
    """The numbers of a tensor; `DatasetError` for one that repeats the few numbers of its file many times."""
    if tensor.layout != torch.strided or tensor.is_meta or tensor.is_neg() or tensor.is_complex():
        raise DatasetError(f"{path}: a tensor of {tuple(tensor.shape)} is not stored as plain numbers")
    if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
        raise DatasetError(f"{path}: a tensor of {tuple(tensor.shape)} has more numbers than the file")
    return np.array(tensor.detach().to(torch.float32).numpy())


def world_command(path: Path) -> str:
    """The command that imports the world model of a checkpoint's program."""
    parts = (VAE, MDRNN, CONTROLLER)
    logdir = path.parent.parent if path.absolute().parent.name in parts else "LOGDIR"
    return f"`{shell_command('import', logdir, '--out', 'world.zip')}`"


def _is_reward_untrained(checkpoint: _Checkpoint, shape: tuple[int, int]) -> bool:
    """Whether the optimiser never saw a gradient of the reward's row of the heads `shape`."""
    optimiser = checkpoint.content.get("optimizer")
    states = optimiser.get("state") if isinstance(optimiser, dict) else None
    for each in states.values() if isinstance(states, dict) else ():
        squares = each.get("square_avg") if isinstance(each, dict) else None
        if isinstance(squares, torch.Tensor) and squares.shape == shape:
            return not array_of(squares, checkpoint.path)[-2].any()
    return False


def _heads_order(config: MDNRNNConfig) -> NDArray[np.int64]:
    """Their rows (means, log deviations: mixture-major; log weights; reward, end) in our order."""
    width = config.mixtures * config.latent
    means = np.arange(width).reshape(config.mixtures, config.latent).T.ravel()
    logits = 2 * width + np.arange(config.mixtures)
    last = 2 * width + config.mixtures
    return np.concatenate([logits, means, width + means, np.arange(last + (not config.has_reward_head), last + 2)])
