"""Bundling: trained models as one file. Pages: dreams.md, dreams-notes.md."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.artifacts.bundle import MAX_RECORDED_STATES, Bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path
from dreamfleet.common.host.stop_signals import Stop, never_stop
from dreamfleet.common.printable import plural
from dreamfleet.worker.training.stages import StageReport

if TYPE_CHECKING:
    from dreamfleet.worker.training.dream_facts import Source

RECORDED = 512  # states of the default layers are 0.6 MB


@dataclass(frozen=True)
class BundleRequest:
    """The models in `data` as the bundle `out`, with at most `recorded` states of the drives.

    `measured` are files of `inspect --json` on the same bundle. `reward` and `end` say how dreams pay and end;
    `None`: as the data do.
    """

    data: Path
    out: Path
    with_weights: bool = False
    recorded: int = RECORDED
    measured: tuple[Path, ...] = ()
    reward: Source | None = None
    end: str | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.recorded <= MAX_RECORDED_STATES:
            raise UsageError(f"--recorded must be from 0 to {MAX_RECORDED_STATES}, not {self.recorded}")


@dataclass(frozen=True)
class BundleReport(StageReport):
    """A bundle that was written: its size in bytes, its controllers' parameters, and its recorded states."""

    bundle: Path
    bytes: int
    sha256: str
    controller_parameters: int
    recorded: int

    @classmethod
    def of(cls, made: Bundle) -> BundleReport:
        """Of a bundle."""
        size = made.path.stat().st_size
        return cls(made.path, size, made.sha256, made.controller_shape.size, made.recorded_count)

    def __str__(self) -> str:
        controllers = f"controllers of {plural(self.controller_parameters, 'parameter')}"
        size = f"{self.bytes / 1e6:.1f} MB"
        return f"{self.bundle}: {size}, sha256 {self.sha256}, {controllers}, {self.recorded} recorded states"


def build_bundle(request: BundleRequest, _stop: Stop = never_stop) -> BundleReport:
    """Write the bundle; errors as in `assemble`."""
    from dreamfleet.worker.training.assemble import assemble

    check_output_path(request.out)
    more: dict[str, Any] = {
        name: getattr(request, name) for name in ("with_weights", "recorded", "measured", "reward", "end")
    }
    return BundleReport.of(assemble(request.data, request.out, request.out.stem, **more))
