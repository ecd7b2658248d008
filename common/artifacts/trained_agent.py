"""An agent that was trained without a world model, as one file: its network, and all that is needed to drive by it.

A stored zip of an ONNX graph and a manifest with its hash, as a bundle is one; it is read within the same bounds.
"""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

from dreamfleet.common.artifacts.onnx_checks import UnsafeModelError, check_model, has_finite_weights, is_empty_graph
from dreamfleet.common.errors import ControllerError
from dreamfleet.common.files.archives import Archive, ArchiveLimits, DamagedArchiveError, open_archive, write_archive
from dreamfleet.common.files.atomic_write import open_output
from dreamfleet.common.files.regular_files import open_regular, read_regular
from dreamfleet.common.serialization.constraints import Between, Length, Word
from dreamfleet.common.serialization.validation import MalformedError, from_plain

FORMAT = 1
MANIFEST, NETWORK = "agent.json", "network.onnx"
MAX_BYTES = 256 << 20  # of the file, and of all that it holds
_LIMITS = ArchiveLimits(MAX_BYTES, members=8)
_MAX_MANIFEST = 1_000_000
MAX_FRAME_SKIP, MAX_STATE_SIZE = 10**6, 10**6

Choice = Annotated[tuple[float, ...], Length(1, 1000)]


@dataclass(frozen=True)
class AgentManifest:
    """What an agent drives in and how, and where it comes from."""

    name: Word  # of the baseline that it was trained as
    task: Word
    preprocessing: Word  # of the pictures that it sees
    choices: Annotated[tuple[Choice, ...], Length(1, 1000)]  # an action each
    frame_skip: Annotated[int, Between(1, MAX_FRAME_SKIP)]  # steps for which a choice is held
    state: Annotated[int, Between(1, MAX_STATE_SIZE)]  # numbers that it remembers from one decision to the next
    provenance: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class TrainedAgent:
    """A network of `picture` and `state` to the `worth` of each choice and `next_state`, and how it drives."""

    manifest: AgentManifest
    network: bytes = field(repr=False)  # ONNX

    @property
    def task(self) -> str:
        """That it was trained in."""
        return self.manifest.task

    @property
    def sha256(self) -> str:
        """Hash of all that its choices follow from: the network, and how it drives."""
        driving = {name: value for name, value in asdict(self.manifest).items() if name not in ("name", "provenance")}
        text = json.dumps({**driving, "network": hashlib.sha256(self.network).hexdigest()}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def save(self, path: Path) -> None:
        """Write what `load` reads, whole or not at all; equal agents give equal files."""
        about = {**asdict(self.manifest), "format": FORMAT, "network": hashlib.sha256(self.network).hexdigest()}
        text = json.dumps(about, indent=1, sort_keys=True, allow_nan=False)
        with open_output(path) as file:
            write_archive(file, [(MANIFEST, text.encode()), (NETWORK, self.network)])

    @classmethod
    def load(cls, path: Path) -> TrainedAgent:
        """Read an agent's file; `ControllerError` says what is wrong with it. What runs the network looks further."""
        try:
            with open_archive(io.BytesIO(read_regular(path, MAX_BYTES)), _LIMITS) as archive:
                return cls._parse(archive)
        except OSError as error:
            raise ControllerError(f"{path} is not an agent's file: {error.strerror}") from error
        except (ValueError, KeyError, TypeError, MalformedError, RecursionError) as error:
            raise ControllerError(f"{path} is not a whole agent's file ({error}): export it again") from error

    @classmethod
    def _parse(cls, archive: Archive) -> TrainedAgent:
        about = json.loads(archive.read(MANIFEST, _MAX_MANIFEST))
        if not isinstance(about, dict):
            raise ValueError(f"{MANIFEST} is no JSON object")
        if (found := about.pop("format")) != FORMAT:
            raise ValueError(f"it is of format {found!r:.20}; this version reads {FORMAT}")
        sha256, network = about.pop("network"), archive.read(NETWORK)
        if hashlib.sha256(network).hexdigest() != sha256:
            raise ValueError(f"{NETWORK} is not the one that its manifest names")
        _check_network(network)
        return cls(from_plain(AgentManifest, about), network)


def is_agent(path: Path) -> bool:
    """Whether a file holds an agent, as far as its names say."""
    try:
        with open_regular(path, MAX_BYTES) as file, open_archive(file, _LIMITS) as archive:
            return MANIFEST in archive.names
    except (OSError, DamagedArchiveError):
        return False


def _check_network(network: bytes) -> None:
    """`ValueError` for what would only show as nonsense on the track."""
    try:
        check_model(network)
    except UnsafeModelError as error:
        raise ValueError(f"{NETWORK} {error}") from error
    if is_empty_graph(network):
        raise ValueError(f"{NETWORK} is an empty graph")
    if not has_finite_weights(network):
        raise ValueError(f"{NETWORK} has weights that are NaN or infinite")
