"""The JSON document in which an experiment keeps what it was begun with and what is finished."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.files.atomic_write import atomic_write, reporting_unwritable_folder
from dreamfleet.common.files.regular_files import read_text

MOST_BYTES = 256 << 20
T = TypeVar("T")


def read_document(path: Path, parse: Callable[[Any], T]) -> T | None:
    """What `parse` makes of the document; `None` if there is none, `DatasetError` if it is damaged."""
    try:
        return parse(json.loads(read_text(path, MOST_BYTES)))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, RecursionError, UsageError) as error:
        raise DatasetError(f"{path} is damaged ({error}); put it back from a copy") from error


def write_document(path: Path, document: Any, flag: str) -> None:
    """Write it, whole or not at all; `DatasetError` with the `flag` that chooses another folder."""
    with reporting_unwritable_folder(path.parent, f"make room, or choose another {flag}"), atomic_write(path) as file:
        file.write((json.dumps(document, indent=1, default=str) + "\n").encode())
