"""Writing pictures to a video file."""

from __future__ import annotations

from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.files.atomic_write import open_output


class Video:
    """An mp4 that grows picture by picture; use it in a `with`. The file appears, whole, when it ends.

    After an error there is no file; with `keep_partial` there is one of the pictures so far.
    """

    def __init__(self, out: Path, frames_per_second: int, *, keep_partial: bool = False) -> None:
        self._out = out.absolute()  # a simulator may change the current folder of its process
        self._rate, self._keep_partial = frames_per_second, keep_partial
        self._output = ExitStack()
        self._container: Any = None
        self._stream: Any = None

    def __enter__(self) -> Video:
        return self

    def __exit__(self, *error: Any) -> None:
        if self._stream is not None:
            self._container.mux(self._stream.encode())
        if self._container is not None:
            self._container.close()
        is_kept = self._keep_partial and self._stream is not None
        self._output.__exit__(*((None, None, None) if is_kept else error))

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Add a picture `(height, width, 3)` with even sides, of the same size as the first."""
        if self._stream is None:
            self._stream = self._open_stream(picture.shape[1], picture.shape[0])
        self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))

    def _open_stream(self, width: int, height: int) -> Any:
        file = self._output.enter_context(open_output(self._out))
        self._container = av.open(file, "w", format="mp4")
        stream = self._container.add_stream("libx264", rate=self._rate)
        stream.width, stream.height = width, height
        stream.pix_fmt = "yuv420p"
        stream.time_base = Fraction(1, self._rate)
        stream.options = {"crf": "23", "preset": "veryfast"}
        return stream
