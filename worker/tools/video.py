"""Writing pictures to a video file."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import DatasetError


class Video:
    """An mp4 that grows picture by picture; use it in a `with`. It is playable even if it ends early."""

    def __init__(self, out: Path, frames_per_second: int) -> None:
        self._out, self._rate = out, frames_per_second
        self._stream: Any = None

    def __enter__(self) -> Video:
        try:
            self._out.parent.mkdir(parents=True, exist_ok=True)
            self._container: Any = av.open(str(self._out), "w")
        except OSError as error:
            raise DatasetError(f"cannot write {self._out}: {error.strerror}; choose another --out") from error
        return self

    def __exit__(self, *_error: object) -> None:
        if self._stream is not None:
            self._container.mux(self._stream.encode())
        self._container.close()
        if self._stream is None:
            self._out.unlink(missing_ok=True)  # no picture came

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Add a picture `(height, width, 3)` with even sides, of the same size as the first."""
        if self._stream is None:
            self._stream = self._open_stream(picture.shape[1], picture.shape[0])
        self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))

    def _open_stream(self, width: int, height: int) -> Any:
        stream = self._container.add_stream("libx264", rate=self._rate)
        stream.width, stream.height = width, height
        stream.pix_fmt = "yuv420p"
        stream.time_base = Fraction(1, self._rate)
        stream.options = {"crf": "23", "preset": "veryfast"}
        return stream
