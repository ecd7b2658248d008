"""Why a worker leaves, in one line for people elsewhere. Pure."""

from __future__ import annotations

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.printable import one_line, truncate

MAX_REASON = 400  # characters, as the message allows


def describe_failure(error: BaseException) -> str:
    """The reason of a worker that an error ends: what users see of it, and the class of an unexpected one."""
    text = one_line(str(error)[: 10 * MAX_REASON].encode(errors="replace").decode())
    return truncate(text if isinstance(error, DreamfleetError) else f"{type(error).__name__}: {text}", MAX_REASON)
