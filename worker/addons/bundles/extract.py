"""A bundle taken apart: its models as checkpoints from which training can continue."""

from dataclasses import dataclass
from pathlib import Path

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.host.stop_signals import Stop, never_stop
from dreamfleet.worker.training.stages import StageReport


@dataclass(frozen=True)
class ExtractRequest:
    """The models of `bundle`, a file or one that ships, as checkpoints in the folder `data`."""

    bundle: str
    data: Path


@dataclass(frozen=True)
class ExtractReport(StageReport):
    """The checkpoints, and the SHA-256 of the bundle."""

    vae: Path
    mdnrnn: Path
    bundle: str

    def __str__(self) -> str:
        return f"{self.vae} and {self.mdnrnn}, of {self.bundle[:12]}"


def extract_models(request: ExtractRequest, _stop: Stop = never_stop) -> ExtractReport:
    """Write the checkpoints; errors as in `unbundle`."""
    from dreamfleet.worker.addons.bundles.unbundle import unbundle

    bundle = find_bundle(request.bundle)
    return ExtractReport(*unbundle(bundle, request.data), bundle.sha256)
