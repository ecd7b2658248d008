"""A stream of JPEGs as `multipart/x-mixed-replace`, each part with metadata in a header.

`dreamfleet live --out -` writes it, and the dashboard, which has no simulator, runs that verb and reads its output.
"""

import json
from collections.abc import Iterator
from typing import IO, Any, BinaryIO

BOUNDARY = "dreamfleet-frame"
CONTENT_TYPE = f"multipart/x-mixed-replace; boundary={BOUNDARY}"
FACTS = "X-Dreamfleet-Facts"  # a JSON object in ASCII
MAX_BYTES = 4 << 20  # of a picture
MAX_HEADER_LINE = 64 << 10  # of a header


def write_part(out: BinaryIO, picture: bytes, facts: dict[str, Any]) -> None:
    """Write one JPEG with its metadata."""
    about = f"Content-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n{FACTS}: {json.dumps(facts)}"
    out.write(f"--{BOUNDARY}\r\n{about}\r\n\r\n".encode("ascii") + picture + b"\r\n")
    out.flush()


def read_parts(stream: IO[bytes]) -> Iterator[tuple[bytes, dict[str, Any]]]:
    """Yield each JPEG with its metadata, until the stream ends or is damaged."""
    while (head := _read_head(stream)) is not None:
        try:
            length, facts = int(head["content-length"]), json.loads(head.get(FACTS.lower(), "{}"))
        except (KeyError, ValueError):
            return
        picture = stream.read(length) if 0 < length <= MAX_BYTES else b""
        if len(picture) != length:
            return
        yield picture, facts


def _read_head(stream: IO[bytes]) -> dict[str, str] | None:
    """The headers of the next part by lower-case name; `None` at the end of the stream."""
    line = b"\r\n"
    while line == b"\r\n":  # the empty line after the previous picture
        line = stream.readline(MAX_HEADER_LINE)
    if line.strip() != f"--{BOUNDARY}".encode():
        return None
    head: dict[str, str] = {}
    while (line := stream.readline(MAX_HEADER_LINE)) not in (b"\r\n", b""):
        name, _, value = line.decode("ascii", "replace").partition(":")
        head[name.strip().lower()] = value.strip()
    return head
