"""The errors that users see. Each text says what happened and what to do about it. Pages: exit-codes.md."""

import shlex
from errno import EACCES, EDQUOT, EISDIR, ENOSPC, EPERM, EROFS
from typing import Any


class DreamfleetError(Exception):
    """Base of expected failures; the command line prints the text as one line and exits with `exit_code`.

    >>> from pathlib import Path
    >>> from dreamfleet import Controller, DreamfleetError
    >>> try:
    ...     Controller.load(Path("missing.npz"))
    ... except DreamfleetError as error:
    ...     print(error)
    no controller at missing.npz
    """

    exit_code = 1

    def __reduce__(self) -> tuple[Any, ...]:
        """Whatever its constructor takes, it reaches another process with its text and fields."""
        return _rebuild, (type(self), self.args, vars(self))


def _rebuild(kind: type[DreamfleetError], args: tuple[Any, ...], fields: dict[str, Any]) -> DreamfleetError:
    error = kind.__new__(kind, *args)
    vars(error).update(fields)
    return error


class UsageError(DreamfleetError):
    """A flag, a configuration key, a name or a preset is invalid.

    >>> import dreamfleet
    >>> try:
    ...     dreamfleet.start_run(generation=5)
    ... except dreamfleet.UsageError as error:
    ...     print(error)
    unknown setting 'generation': did you mean 'generations'?
    """

    exit_code = 2


class BundleError(DreamfleetError):
    """A world-model bundle is missing, damaged, or not the expected one."""


class CacheError(BundleError):
    """A bundle that cannot be written into the user's cache."""


class DownloadError(BundleError):
    """The download of a world model failed or was damaged; a later try, or another source, may succeed."""


class ControllerError(DreamfleetError):
    """A controller file is damaged or does not fit the task or the bundle."""


class DatasetError(DreamfleetError):
    """A folder of recorded episodes is empty, damaged, not writable, or has another shape."""


class JournalError(DreamfleetError):
    """A run's journal is missing, damaged, locked, not writable, or not a journal."""


class DamagedJournalError(JournalError):
    """A run's journal is damaged, and only a copy helps."""


class NotWritableNowError(JournalError):
    """The disk of a run is full, or its journal locked; what was not written can be written later."""


def write_error(path: object, error: OSError) -> JournalError:
    """The error for a file of a run that cannot be written."""
    what = f"cannot write {path}: {error.strerror or error}"  # docs/how-to/troubleshooting.md has this text
    if is_disk_full(error):
        return NotWritableNowError(f"{what}; make room")
    remedies = {EISDIR: "; remove it", EACCES: "; make it writable", EPERM: "; make it writable",
                EROFS: "; make it writable"}  # fmt: skip
    return JournalError(what + remedies.get(error.errno or 0, ""))


def is_disk_full(error: OSError) -> bool:
    """Whether room on the disk, or in somebody's share of it, is what is missing."""
    return error.errno in (ENOSPC, EDQUOT)


class InternalError(DreamfleetError):
    """A bug left the state in memory inconsistent; the files are intact."""


class ConnectionFailedError(DreamfleetError):
    """Nobody answers over Zenoh, or the address cannot be listened on."""


class HandshakeRejectedError(ConnectionFailedError):
    """The other side rejects the connection; the text says why."""


class AccessError(DreamfleetError):
    """A join file or an authority's folder is missing, damaged, expired, or has the wrong role."""


class RefusedError(DreamfleetError):
    """The other side answered and refused the request; a worker started with `flag`, its name and value, may join."""

    def __init__(self, text: str, flag: tuple[str, str] | None = None) -> None:
        super().__init__(text if flag is None else f"{text}: `{shlex.join(('dreamfleet', 'worker', *flag))}`")
        self.text, self.flag = text, flag


class MissingExtraError(DreamfleetError):
    """A verb needs an extra that is not installed."""


class StoppedError(DreamfleetError):
    """A verb was interrupted; the text says what is kept and how to continue."""

    exit_code = 130  # the exit code of Ctrl-C in a shell


class NoDisplayError(DreamfleetError):
    """A verb needs to open a window, and there is no display."""
