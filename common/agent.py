"""An agent that was trained without a world model, as one file: its network, and all that is needed to drive by it.

A stored zip of an ONNX graph and a manifest with its hash, as a bundle is one; it is read within the same bounds.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

from dreamfleet.common.archives import Archive, DamagedError, Limits, open_archive
from dreamfleet.common.codec import MalformedError, from_plain
from dreamfleet.common.errors import ControllerError
from dreamfleet.common.files import open_regular, read_regular
from dreamfleet.common.messages import Between, Length, Word
from dreamfleet.common.saving import saving
from dreamfleet.common.tensors import UnfitError, check_fit, is_empty, weights_finite

FORMAT = 1
MANIFEST, NETWORK = "agent.json", "network.onnx"
MOST_BYTES = 256 << 20  # of the file, and of all that it holds
_LIMITS = Limits(MOST_BYTES, members=8)
_MOST_MANIFEST = 1_000_000
_EPOCH = (1980, 1, 1, 0, 0, 0)
MOST_HELD, MOST_STATE = 10**6, 10**6

Choice = Annotated[tuple[float, ...], Length(1, 1000)]


@dataclass(frozen=True)
class AgentManifest:
    """What an agent drives in and how, and where it comes from."""

    name: Word  # of the baseline that it was trained as
    task: Word
    preprocessing: Word  # of the pictures that it sees
    choices: Annotated[tuple[Choice, ...], Length(1, 1000)]  # an action each
    frame_skip: Annotated[int, Between(1, MOST_HELD)]  # steps for which a choice is held
    state: Annotated[int, Between(1, MOST_STATE)]  # numbers that it remembers from one decision to the next
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
        with saving(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for name, data in ((MANIFEST, text.encode()), (NETWORK, self.network)):
                archive.writestr(zipfile.ZipInfo(name, _EPOCH), data)

    @classmethod
    def load(cls, path: Path) -> TrainedAgent:
        """Read an agent's file; `ControllerError` says what is wrong with it. What runs the network looks further."""
        try:
            with open_archive(io.BytesIO(read_regular(path, MOST_BYTES)), _LIMITS) as archive:
                return cls._of(archive)
        except OSError as error:
            raise ControllerError(f"{path} is not an agent's file: {error.strerror}") from error
        except (ValueError, KeyError, TypeError, MalformedError, RecursionError) as error:
            raise ControllerError(f"{path} is not a whole agent's file ({error}): export it again") from error

    @classmethod
    def _of(cls, archive: Archive) -> TrainedAgent:
        about = json.loads(archive.read(MANIFEST, _MOST_MANIFEST))
        if not isinstance(about, dict):
            raise ValueError(f"{MANIFEST} is no JSON object")
        if (found := about.pop("format")) != FORMAT:
            raise ValueError(f"it is of format {found!r:.20}; this version reads {FORMAT}")
        sha256, network = about.pop("network"), archive.read(NETWORK)
        if hashlib.sha256(network).hexdigest() != sha256:
            raise ValueError(f"{NETWORK} is not the one that its manifest names")
        _look(network)
        return cls(from_plain(AgentManifest, about), network)


def is_agent(path: Path) -> bool:
    """Whether a file holds an agent, as far as its names say."""
    try:
        with open_regular(path, MOST_BYTES) as file, open_archive(file, _LIMITS) as archive:
            return MANIFEST in archive.names
    except (OSError, DamagedError):
        return False


def _look(network: bytes) -> None:
    """`ValueError` for what would only show as nonsense on the track."""
    try:
        check_fit(network)
    except UnfitError as error:
        raise ValueError(f"{NETWORK} {error}") from error
    if is_empty(network):
        raise ValueError(f"{NETWORK} is an empty graph")
    if not weights_finite(network):
        raise ValueError(f"{NETWORK} has weights that are NaN or infinite")
