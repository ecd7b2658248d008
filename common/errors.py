"""The errors that people see: each text says what happened and what to do about it."""

from __future__ import annotations


class DreamfleetError(Exception):
    """An expected failure; the command line prints its text as one line and exits with `exit_code`.

    >>> from pathlib import Path
    >>> from dreamfleet import Controller, DreamfleetError
    >>> try:
    ...     Controller.load(Path("missing.npz"))
    ... except DreamfleetError as error:
    ...     print(error)
    no controller at missing.npz
    """

    exit_code = 1


class UsageError(DreamfleetError):
    """What the user asked for is not well formed: a flag, a configuration key, a name, a preset."""

    exit_code = 2


class BundleError(DreamfleetError):
    """A world-model bundle is missing, damaged, or not the one that was named."""


class DownloadError(BundleError):
    """A world model did not come, or came as something else: later, or from somebody else, it may come."""


class ControllerError(DreamfleetError):
    """A controller file is damaged or does not fit the task or the bundle."""


class DatasetError(DreamfleetError):
    """A folder of recorded episodes is empty, damaged or of another shape."""


class JournalError(DreamfleetError):
    """A run's journal is missing, foreign, damaged, locked or cannot be written."""


class InternalError(DreamfleetError):
    """A fault of ours left in doubt what is in memory; what is on disk is whole."""


class ConnectionFailedError(DreamfleetError):
    """Nobody answered over Zenoh, or the address cannot be listened on."""


class HandshakeRejectedError(ConnectionFailedError):
    """Somebody listens there and does not let this side in; the text says why."""


class AccessError(DreamfleetError):
    """A join file or an authority's folder is missing, damaged, expired, or of another role than is needed."""


class RefusedError(DreamfleetError):
    """The other side answered, and said no."""


class MissingExtraError(DreamfleetError):
    """A verb needs packages of an extra that is not installed."""


class StoppedError(DreamfleetError):
    """Somebody asked a verb to stop; the text says what is kept and how to go on."""

    exit_code = 130  # as a shell says it of Ctrl-C


class NoDisplayError(DreamfleetError):
    """A verb opens a window, and there is no screen to open it on."""
