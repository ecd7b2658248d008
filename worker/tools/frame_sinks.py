"""Where what is watched goes when it goes into no window: a video, a folder of pictures, or a stream of them."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import pygame

from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path, open_output, reporting_write_errors
from dreamfleet.common.monitoring.mjpeg import write_part
from dreamfleet.worker.tools.canvas import Frame
from dreamfleet.worker.tools.live_view import CaptionedFrame

if TYPE_CHECKING:  # of the extra `views`
    from dreamfleet.worker.tools.video import Video

VIDEO = ".mp4"


SendFrame = Callable[[CaptionedFrame | None], bool]
"""Shows a picture, or nothing yet; whether the viewer wants more."""


@contextmanager
def open_sink(out: str, rate: int, stdout: BinaryIO) -> Iterator[SendFrame]:
    """What `--out` names: a video's file, a folder, or `-`; `UsageError` where nothing can be written."""
    path = Path(out)
    if out == "-":
        yield lambda shown: shown is None or _write_part(stdout, shown)
    elif path.suffix == VIDEO:
        from dreamfleet.worker.tools.video import Video

        check_output_path(path)
        with Video(path, rate) as video:
            yield lambda shown: shown is None or _write_frame(video, shown)
    elif path.suffix or path.is_file():
        raise UsageError(f"--out {out}: name an .mp4, a folder for pictures, or - for a stream of them")
    else:
        with reporting_write_errors(path):
            path.mkdir(parents=True, exist_ok=True)
        numbers = count()
        yield lambda shown: shown is None or _write_picture(path / f"{next(numbers):06d}.png", shown)


def _write_frame(video: Video, shown: CaptionedFrame) -> bool:
    """One more frame."""
    video.add(shown.picture)
    return True


def _write_part(out: BinaryIO, shown: CaptionedFrame) -> bool:
    """A part of `multipart/x-mixed-replace`, as a browser shows it in an image, unless the reader is gone."""
    try:
        write_part(out, encode_picture(shown.picture, "jpg"), shown.facts)
    except BrokenPipeError:
        return False
    return True


def _write_picture(path: Path, shown: CaptionedFrame) -> bool:
    """A PNG, and beside it its facts as JSON."""
    with open_output(path) as file:
        file.write(encode_picture(shown.picture, "png"))
    with open_output(path.with_suffix(".json")) as file:
        file.write(f"{json.dumps(shown.facts)}\n".encode())
    return True


def encode_picture(picture: Frame, kind: str) -> bytes:
    """A picture `(height, width, 3)` as `png` or `jpg`."""
    file = io.BytesIO()
    size = picture.shape[1], picture.shape[0]
    pygame.image.save(pygame.image.frombuffer(picture.tobytes(), size, "RGB"), file, f"frame.{kind}")
    return file.getvalue()
