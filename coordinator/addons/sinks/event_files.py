"""Reading TensorBoard's event files, so that a record goes on where it ended."""

from collections.abc import Iterator
from pathlib import Path

from dreamfleet.common.files.tensorboard import EVENTS


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
