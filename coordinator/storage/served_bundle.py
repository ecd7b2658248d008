"""The world model that a run serves: read through one open file, which outlives its name and which nobody can take."""

import os
import shutil
from pathlib import Path

from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.protocol.messages import MAX_PART


class ServedBundle:
    """A run's own copy of its bundle; any thread may read it. Close it."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        self._name = path.name

    def close(self) -> None:
        """Release the file."""
        self._file.close()

    def read_part(self, offset: int, length: int) -> tuple[int, int, bytes]:  # docs/reference/protocol.md
        """Where a part begins, how long the whole is, and the part: as much of what is asked for as there is."""
        total = os.fstat(self._file.fileno()).st_size
        offset = min(max(offset, 0), total)
        return offset, total, os.pread(self._file.fileno(), min(max(length, 0), MAX_PART), offset)

    def restore_into(self, folder: Path) -> bool:
        """Write it into a folder that lacks it; whether that was so."""
        if (folder / self._name).exists():
            return False
        with (
            Path(f"/proc/self/fd/{self._file.fileno()}").open("rb") as source,
            atomic_write(folder / self._name) as copy,
        ):
            shutil.copyfileobj(source, copy)
        return True
