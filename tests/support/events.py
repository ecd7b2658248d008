"""Read TensorBoard's event files."""

from tensorboardX.proto.event_pb2 import Event


def scalars(folder):
    """Steps and values of each scalar, by name, from all event files in a folder."""
    found = {}
    for path in sorted(folder.glob("events.out.tfevents.*")):
        for record in _records(path.read_bytes()):
            event = Event.FromString(record)
            for value in event.summary.value:
                if value.HasField("simple_value"):
                    found.setdefault(value.tag, []).append((event.step, value.simple_value))
    return found


def _records(data):
    """The records of TensorFlow's format: a length, its checksum, the bytes, their checksum."""
    while data:
        size = int.from_bytes(data[:8], "little")
        yield data[12 : 12 + size]
        data = data[16 + size :]
