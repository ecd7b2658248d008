"""The frozen world model on ONNX Runtime: one thread, and a row's bits do not depend on its batch."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from common.bundle import DECODER, ENCODER, POLICY, Bundle
from common.errors import BundleError

Floats = NDArray[np.float32]
Pictures = NDArray[np.uint8]


def open_part(bundle: Bundle, name: str) -> onnxruntime.InferenceSession:
    """A session on one of a bundle's graphs; one thread, because scoring processes are one a core."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(bundle.read(name), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the runtime's errors share no public base
        raise BundleError(f"{bundle.path}: {name} cannot be run ({error})") from error


class Step(NamedTuple):
    """What one policy step gives, a row an episode."""

    action: Floats
    hidden: Floats
    cell: Floats
    latent: Floats


class PolicyStep:
    """Encoder, controller and LSTM in one graph."""

    def __init__(self, bundle: Bundle) -> None:
        self._run = open_part(bundle, POLICY).run
        self.shape = bundle.controller_shape
        self.hidden_size = bundle.manifest.hidden

    def step(self, picture: Pictures, parameters: Floats, hidden: Floats, cell: Floats) -> Step:
        """Act and advance: `picture` (N, 64, 64, 3), `parameters` (N, size), `hidden` and `cell` (N, hidden)."""
        feed = {"picture": picture, "parameters": parameters, "hidden": hidden, "cell": cell}
        return Step(*self._run(["action", "next_hidden", "next_cell", "latent"], feed))

    def zero_state(self, rows: int) -> tuple[Floats, Floats]:
        """Hidden and cell state before the first step."""
        state = np.zeros((rows, self.hidden_size), dtype=np.float32)
        return state, state.copy()


class Encoder:
    """Pictures to latents."""

    def __init__(self, bundle: Bundle) -> None:
        self._run = open_part(bundle, ENCODER).run

    def encode(self, picture: Pictures) -> tuple[Floats, Floats]:
        """`mu` and `logvar` (N, latent) of `picture` (N, 64, 64, 3)."""
        mu, logvar = self._run(["mu", "logvar"], {"picture": picture})
        return mu, logvar


class Decoder:
    """Latents to pictures."""

    def __init__(self, bundle: Bundle) -> None:
        self._run = open_part(bundle, DECODER).run

    def decode(self, latent: Floats) -> Pictures:
        """`picture` (N, 64, 64, 3) of `latent` (N, latent)."""
        (picture,) = self._run(["picture"], {"latent": latent})
        result: Any = picture
        return np.asarray(result, dtype=np.uint8)
