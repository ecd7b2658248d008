"""Writing pictures to a video file."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO, Self

import av
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.files.atomic_write import atomic_write, reporting_write_errors


class Video:
    """An mp4 that grows picture by picture; use it in a `with`. The file appears, whole, when it ends.

    After an error there is no file; with `keep_partial` there is one of the pictures so far.
    """

    def __init__(self, out: Path, frames_per_second: int, *, keep_partial: bool = False) -> None:
        self._out = out.absolute()  # a simulator may change the current folder of its process
        self._rate, self._keep_partial = frames_per_second, keep_partial
        self._output = ExitStack()
        self._file: _WatchedFile | None = None
        self._container: Any = None
        self._stream: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        if self._file is None:
            return
        with self._write_errors():
            if self._file.fault is None and (error[0] is None or self._keep_partial):
                with self._output:
                    self._container.mux(self._stream.encode())
                    self._container.close()
                return
            with suppress(av.error.FFmpegError, OSError):
                self._container.close()
            self._output.__exit__(*error)

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Add a picture `(height, width, 3)` with even sides, of the same size as the first.

        `DreamfleetError` if it cannot be written.
        """
        with self._write_errors():
            if self._stream is None:
                self._stream = self._open_stream(picture.shape[1], picture.shape[0])
            self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))

    def _open_stream(self, width: int, height: int) -> Any:
        self._file = _WatchedFile(self._output.enter_context(atomic_write(self._out)))
        self._container = av.open(self._file, "w", format="mp4")
        stream = self._container.add_stream("libx264", rate=self._rate)
        stream.width, stream.height = width, height
        stream.pix_fmt = "yuv420p"
        stream.time_base = Fraction(1, self._rate)
        stream.options = {"crf": "23", "preset": "veryfast"}
        return stream

    @contextmanager
    def _write_errors(self) -> Iterator[None]:
        """Turn what the file's writes raised into a `DreamfleetError`: the encoder says only that they failed."""
        with reporting_write_errors(self._out):
            try:
                yield
            except av.error.FFmpegError as error:
                if self._file is None or self._file.fault is None:
                    raise
                raise self._file.fault from error


class _WatchedFile:
    """A file for the encoder; `fault` is the error of a write, if one failed."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.seek, self.tell = file.seek, file.tell
        self.fault: OSError | None = None

    def write(self, data: bytes) -> int:
        """Write all of it."""
        try:
            return self._file.write(data)
        except OSError as error:
            self.fault = error
            raise
