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
from dreamfleet.common.parts import write_part
from dreamfleet.common.saving import check_out, saving, told
from dreamfleet.worker.tools.canvas import Frame
from dreamfleet.worker.tools.glass import Shown

if TYPE_CHECKING:  # of the extra `views`
    from dreamfleet.worker.tools.video import Video

VIDEO = ".mp4"


Show = Callable[[Shown | None], bool]
"""Shows a picture, or nothing yet; whether the viewer wants more."""


@contextmanager
def outlet(out: str, rate: int, stdout: BinaryIO) -> Iterator[Show]:
    """What `--out` names: a video's file, a folder, or `-`; `UsageError` where nothing can be written."""
    path = Path(out)
    if out == "-":
        yield lambda shown: shown is None or _stream(stdout, shown)
    elif path.suffix == VIDEO:
        from dreamfleet.worker.tools.video import Video

        check_out(path)
        with Video(path, rate) as video:
            yield lambda shown: shown is None or _frame(video, shown)
    elif path.suffix or path.is_file():
        raise UsageError(f"--out {out}: name an .mp4, a folder for pictures, or - for a stream of them")
    else:
        with told(path):
            path.mkdir(parents=True, exist_ok=True)
        numbers = count()
        yield lambda shown: shown is None or _still(path / f"{next(numbers):06d}.png", shown)


def _frame(video: Video, shown: Shown) -> bool:
    """One more frame."""
    video.add(shown.picture)
    return True


def _stream(out: BinaryIO, shown: Shown) -> bool:
    """A part of `multipart/x-mixed-replace`, as a browser shows it in an image, unless the reader is gone."""
    try:
        write_part(out, encoded(shown.picture, "jpg"), shown.facts)
    except BrokenPipeError:
        return False
    return True


def _still(path: Path, shown: Shown) -> bool:
    """A PNG, and beside it its facts as JSON."""
    with saving(path) as file:
        file.write(encoded(shown.picture, "png"))
    with saving(path.with_suffix(".json")) as file:
        file.write(f"{json.dumps(shown.facts)}\n".encode())
    return True


def encoded(picture: Frame, kind: str) -> bytes:
    """A picture `(height, width, 3)` as `png` or `jpg`."""
    file = io.BytesIO()
    size = picture.shape[1], picture.shape[0]
    pygame.image.save(pygame.image.frombuffer(picture.tobytes(), size, "RGB"), file, f"frame.{kind}")
    return file.getvalue()
