"""Outputs of live frames other than a window: a video, a folder of pictures, or a stream."""

import io
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import BinaryIO

import pygame

from dreamfleet.common.addons.frames.mjpeg import write_part
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path, open_output, reporting_write_errors
from dreamfleet.worker.addons.live.live_view import CaptionedFrame
from dreamfleet.worker.addons.recording.canvas import Frame

VIDEO = ".mp4"

SendFrame = Callable[[CaptionedFrame | None], bool]
"""Writes a frame (`None`: there is none yet); returns whether the viewer wants more."""


@contextmanager
def open_sink(out: str, rate: int, stdout: BinaryIO) -> Iterator[SendFrame]:
    """Open what `--out` names: a video file, a folder, or `-`; `UsageError` if it cannot be written."""
    path = Path(out).absolute()  # a simulator may change the current folder of its process
    if out == "-":
        # Parts of `multipart/x-mixed-replace`, which browsers show in an image.
        yield _sender(lambda shown: write_part(stdout, encode_picture(shown.picture, "jpg"), shown.facts))
    elif path.suffix == VIDEO:
        from dreamfleet.worker.addons.recording.video import Video  # it needs a package of the extra `views`

        check_output_path(path)
        with Video(path, rate, keep_partial=True) as video:
            yield _sender(lambda shown: video.add(shown.picture))
    elif path.suffix or path.is_file():
        raise UsageError(f"--out {out}: name an .mp4, a folder for pictures, or - for a stream of them")
    else:
        with reporting_write_errors(path):
            path.mkdir(parents=True, exist_ok=True)
        numbers = count()
        yield _sender(lambda shown: _write_picture(path / f"{next(numbers):06d}.png", shown))


def _sender(write: Callable[[CaptionedFrame], None]) -> SendFrame:
    def send(shown: CaptionedFrame | None) -> bool:
        try:
            if shown is not None:
                write(shown)
        except BrokenPipeError:  # the reader of a stream is gone
            return False
        return True

    return send


def _write_picture(path: Path, shown: CaptionedFrame) -> None:
    """Write a PNG, and its facts as JSON beside it."""
    with open_output(path) as file:
        file.write(encode_picture(shown.picture, "png"))
    with open_output(path.with_suffix(".json")) as file:
        file.write(f"{json.dumps(shown.facts)}\n".encode())


def encode_picture(picture: Frame, kind: str) -> bytes:
    """A picture `(height, width, 3)` as the bytes of a `png` or `jpg` file."""
    file = io.BytesIO()
    size = picture.shape[1], picture.shape[0]
    pygame.image.save(pygame.image.frombuffer(picture.tobytes(), size, "RGB"), file, f"frame.{kind}")
    return file.getvalue()
