"""A training's loss curve on disk."""

from __future__ import annotations

import json
from pathlib import Path

from dreamfleet.worker.training.room import told_where_full


def append_curve(path: Path, **values: float) -> None:
    """One point as a line of JSON, whole or not at all; `DatasetError` where there is no room for it."""
    line = (json.dumps({name: round(value, 6) for name, value in values.items()}) + "\n").encode()
    with told_where_full(path), path.open("ab", buffering=0) as file:
        end = file.seek(0, 2)
        try:
            while line:
                line = line[file.write(line) :]
        except OSError:
            file.truncate(end)
            raise
