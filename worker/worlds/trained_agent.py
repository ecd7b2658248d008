"""An agent trained without a world model: a stored zip of an ONNX graph and a manifest. Pages: baselines.md."""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from dreamfleet.common.artifacts.bundle import MAX_MANIFEST
from dreamfleet.common.artifacts.onnx_checks import find_fault
from dreamfleet.common.errors import ControllerError
from dreamfleet.common.files.archives import Archive, ArchiveLimits, DamagedArchiveError, open_archive, write_archive
from dreamfleet.common.files.atomic_write import open_output
from dreamfleet.common.files.regular_files import open_regular, read_regular
from dreamfleet.common.printable import plural
from dreamfleet.common.schema.display import Displayed
from dreamfleet.common.schema.validation import MalformedError, Word, from_plain

FORMAT = 1
MANIFEST, NETWORK = "agent.json", "network.onnx"
MAX_BYTES = 256 << 20  # of the file, and of its members together; docs/how-to/security.md says it too
_LIMITS = ArchiveLimits(MAX_BYTES, members=8)
MAX_FRAME_SKIP, MAX_STATE_SIZE = 10**6, 10**6

Choice = Annotated[tuple[float, ...], Meta(min_length=1, max_length=1000)]


@dataclass(frozen=True)
class AgentManifest:
    """An agent's task, preprocessing, actions and provenance."""

    name: Word  # of its baseline
    task: Word
    preprocessing: Word  # of its input pictures
    choices: Annotated[tuple[Choice, ...], Meta(min_length=1, max_length=1000)]  # the actions to choose from
    frame_skip: Annotated[int, Meta(ge=1, le=MAX_FRAME_SKIP)]  # steps for which an action is repeated
    state: Annotated[int, Meta(ge=1, le=MAX_STATE_SIZE)]  # length of its recurrent state
    provenance: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, repr=False)
class TrainedAgent(Displayed):
    """A network and its manifest: inputs `picture` and `state`, outputs `worth` of each choice and `next_state`."""

    manifest: AgentManifest
    network: bytes  # ONNX

    def _display(self) -> tuple[str, dict[str, object]]:
        about = self.manifest
        facts = {
            "baseline": about.name,
            "task": about.task,
            "pictures": about.preprocessing,
            "choices": len(about.choices),
            "steps an action": about.frame_skip,
            "recurrent state": about.state,
            "SHA-256": self.sha256[:12],
        }
        choices = plural(len(about.choices), "action")
        return f"TrainedAgent {about.name} of {about.task}: {choices} to choose from", facts

    @property
    def task(self) -> str:
        """The task that it was trained in."""
        return self.manifest.task

    @property
    def sha256(self) -> str:
        """Hash of all that determines its actions; `name` and `provenance` are left out."""
        driving = {name: value for name, value in asdict(self.manifest).items() if name not in ("name", "provenance")}
        text = json.dumps({**driving, "network": hashlib.sha256(self.network).hexdigest()}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def save(self, path: Path) -> None:
        """Write a file that `load` reads, atomically; equal agents give equal files.

        `ControllerError`, and no file, for a network that `load` would refuse.
        """
        if fault := find_fault(self.network):
            raise ControllerError(f"{path} was not written: its {NETWORK} {fault}")
        about = {**asdict(self.manifest), "format": FORMAT, "network": hashlib.sha256(self.network).hexdigest()}
        text = json.dumps(about, indent=1, sort_keys=True, allow_nan=False)
        with open_output(path) as file:
            write_archive(file, [(MANIFEST, text.encode()), (NETWORK, self.network)])

    @classmethod
    def load(cls, path: Path) -> TrainedAgent:
        """Read an agent's file; `ControllerError` describes what is wrong with it."""
        try:
            with open_archive(io.BytesIO(read_regular(path, MAX_BYTES)), _LIMITS) as archive:
                return cls._parse(archive)
        except OSError as error:
            raise ControllerError(f"{path} is not an agent's file: {error.strerror}") from error
        except (ValueError, KeyError, TypeError, MalformedError, RecursionError) as error:
            raise ControllerError(f"{path} is not a whole agent's file ({error}): export it again") from error

    @classmethod
    def _parse(cls, archive: Archive) -> TrainedAgent:
        about = json.loads(archive.read(MANIFEST, MAX_MANIFEST))
        if not isinstance(about, dict):
            raise ValueError(f"{MANIFEST} is not a JSON object")
        if (found := about.pop("format")) != FORMAT:
            raise ValueError(f"it has format {found!r:.20}; this version reads {FORMAT}")
        sha256, network = about.pop("network"), archive.read(NETWORK)
        if hashlib.sha256(network).hexdigest() != sha256:
            raise ValueError(f"the hash of {NETWORK} is not the one in its manifest")
        if fault := find_fault(network):
            raise ValueError(f"{NETWORK} {fault}")
        return cls(from_plain(AgentManifest, about), network)


def is_agent(path: Path) -> bool:
    """Whether a file is an agent's, by the names of its members alone."""
    try:
        with open_regular(path, MAX_BYTES) as file, open_archive(file, _LIMITS) as archive:
            return MANIFEST in archive.names
    except (OSError, DamagedArchiveError):
        return False
