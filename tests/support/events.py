"""What stands in TensorBoard's event files."""

from tensorboardX.proto.event_pb2 import Event


def scalars(folder):
    """By the name of each scalar its steps and values, over all event files in a folder, in their order."""
    found = {}
    for path in sorted(folder.glob("events.out.tfevents.*")):
        for record in _records(path.read_bytes()):
            event = Event.FromString(record)
            for value in event.summary.value:
                if value.HasField("simple_value"):
                    found.setdefault(value.tag, []).append((event.step, value.simple_value))
    return found


def _records(data):
    """Of TensorFlow's record format: a length, its checksum, the bytes, their checksum."""
    while data:
        size = int.from_bytes(data[:8], "little")
        yield data[12 : 12 + size]
        data = data[16 + size :]
