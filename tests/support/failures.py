"""Failures of attempts at jobs, in short."""

from dreamfleet.common.protocol.failures import Failure, FailureKind


def failure(cause: str, detail: str = "", kind: FailureKind = "other") -> Failure:
    """A failure of this cause; `detail` is different each time."""
    return Failure(f"{cause}: {detail}" if detail else cause, cause, kind)
