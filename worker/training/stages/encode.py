"""Encoding: the pictures of a data set's drives as latents of its VAE."""

from dataclasses import dataclass
from pathlib import Path

from dreamfleet.common.errors import StoppedError
from dreamfleet.common.host.stop_signals import Stop, never_stop
from dreamfleet.common.printable import plural
from dreamfleet.worker.training.stages import StageReport


@dataclass(frozen=True)
class EncodeRequest:
    """The data set, which has a trained VAE."""

    data: Path


@dataclass(frozen=True)
class EncodeReport(StageReport):
    """The frames that were encoded now, and whether each was mirrored too."""

    data: Path
    new_frames: int
    mirrored: bool

    def __str__(self) -> str:
        also = ", each also mirrored" if self.mirrored else ""
        return f"{self.data}: {plural(self.new_frames, 'frame')} encoded{also}"


def encode_drives(request: EncodeRequest, stop: Stop = never_stop) -> EncodeReport:
    """Encode the drives that lack latents of this VAE, with a progress bar on stderr.

    `DatasetError` without a VAE or for damaged drives. After a `StoppedError` the same request goes on.
    """
    from dreamfleet.worker.training.torch_setup import configure_process

    configure_process()  # before torch is loaded
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.worker.training.data.dataset import episode_paths
    from dreamfleet.worker.training.encode import encode, encodes_mirrored

    total, frames = len(episode_paths(request.data)), 0
    with progress_bar("encode", total, "episodes") as bar:
        for done, count in enumerate(encode(request.data), start=1):
            frames += count
            bar.update(done)
            if stop():
                raise StoppedError(f"stopped: {request.data} keeps what is encoded; the same command continues")
        bar.update(total)  # with those that were encoded before
    return EncodeReport(request.data, frames, encodes_mirrored(request.data))
