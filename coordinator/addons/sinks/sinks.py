"""Records of a run's curves in other programs: the contract, and TensorBoard's.

`docs/how-to/wandb_sink.py` and `mlflow_sink.py` are others.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Protocol

from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import reporting_write_errors
from dreamfleet.common.files.regular_files import is_file
from dreamfleet.common.files.tensorboard import EVENTS, EXTRA, open_event_file
from dreamfleet.common.host.packages import check_modules
from dreamfleet.common.host.trusted_modules import find_attribute, import_trusted
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.addons.runs.export import add_settings
from dreamfleet.coordinator.settings.live_log import SinkName, parse_sink

OWNER = "run_uid"  # a file beside TensorBoard's, with the identity of the run that writes there


class Sink(Protocol):
    """A record of one run, new or continued, made from the WHERE of its name and the run; methods may raise any error.

    `known` is what the record holds, by name and step; names have `__` where programs have `/`.
    """

    known: dict[str, dict[int, float]]

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        """Add numbers of one step; they are in the record after `flush`."""

    def flush(self) -> None:
        """Write what was added."""

    def rewind(self, step: int) -> None:
        """Discard what the record holds from this step on, where the program can."""

    def close(self) -> None:
        """End the record so that it can be continued."""


def open_sink(name: SinkName, run: RunFolder) -> Sink:
    """Open the record of a run."""
    return _find(name)(name.where, run)


def check_sinks(texts: Iterable[str]) -> None:
    """`UsageError` if a sink or its package is not installed on this host, or is in a module that is not trusted."""
    for text in texts:
        kind = _find(parse_sink(text))
        if missing := [each for each in ("log", "flush", "rewind", "close") if not hasattr(kind, each)]:
            raise UsageError(f"log_to {text!r} lacks {', '.join(missing)}: {Sink.__module__}.Sink says what each does")


def _find(name: SinkName) -> Callable[[str, RunFolder], Sink]:
    if not name.module:
        try:
            check_modules(["tensorboardX"])
        except ModuleNotFoundError as error:
            raise UsageError(f"log_to {name.kind!r} needs the package {error.name!r}: {EXTRA}") from error
        return TensorBoardSink
    try:
        module = import_trusted(name.module, f"log_to {name.kind!r}")
        kind: Callable[[str, RunFolder], Sink] = find_attribute(module, name.kind.partition(":")[2])
    except (ImportError, AttributeError) as error:
        raise UsageError(f"log_to {name.kind!r} cannot be loaded: {error}") from error
    return kind


class TensorBoardSink:
    """Event files in the run's folder, or in its own folder below the one that is named."""

    def __init__(self, where: str, run: RunFolder) -> None:
        self._folder = Path(where) / run.name if where else run.path / "tensorboard"
        owner = self._folder / OWNER
        if is_file(owner) and owner.read_text() != run.uid:
            raise UsageError(f"{self._folder} holds the curves of another run of this name, so name another folder")
        self.known = {name.replace("/", "__"): points for name, points in read_scalars(self._folder).items()}
        self._stack = ExitStack()
        self._events = self._stack.enter_context(open_event_file(self._folder))
        owner.write_text(run.uid)
        if not self.known:
            add_settings(self._events, run)

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        """Write one record."""
        with reporting_write_errors(self._folder):
            self._events.add(step, **numbers)

    def flush(self) -> None:
        """`log` has written it."""

    def rewind(self, step: int) -> None:
        """Begin a session at the step: TensorBoard discards earlier points from there on."""
        self._events.begin(step)
        self.known = {name: {at: each for at, each in one.items() if at < step} for name, one in self.known.items()}

    def close(self) -> None:
        """Close the file."""
        self._stack.close()


def read_scalars(folder: Path) -> dict[str, dict[int, float]]:
    """The values of each scalar by its steps, from all event files in `folder`, as TensorBoard shows them.

    A last record that a killed process left incomplete is skipped.
    """
    from tensorboardX.proto.event_pb2 import Event, SessionLog

    found: dict[str, dict[int, float]] = {}
    for path in sorted(folder.glob(EVENTS)):
        for record in _records(path.read_bytes()):
            event = Event.FromString(record)
            if event.session_log.status == SessionLog.START:
                found = {name: {at: each for at, each in one.items() if at < event.step} for name, one in found.items()}
            for value in event.summary.value:
                if value.HasField("simple_value"):
                    found.setdefault(value.tag, {})[event.step] = value.simple_value
    return found


def _records(data: bytes) -> Iterator[bytes]:
    """The whole records of TensorFlow's format: a length, its checksum, the bytes, their checksum."""
    start = 0
    while (end := start + 16 + int.from_bytes(data[start : start + 8], "little")) <= len(data):
        yield data[start + 12 : end - 4]
        start = end
