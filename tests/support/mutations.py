"""Damaged messages and files."""

import hashlib
import io
import json
import random
import resource
import zipfile
from time import process_time

from dreamfleet.common.artifacts.bundle import MANIFEST
from dreamfleet.common.protocol.codec import encode
from tests.support.samples import MSGPACK

WHOLE = [encode(message) for message in MSGPACK.values()]
NUMBERS = [
    b"-1", b"0", b"99999999999999999999", b"1e999", b"NaN", b"null", b"[]", b"{}", b'"x"', b"1" * 5000, b"[" * 3000,
]  # fmt: skip
MOST_SECONDS, MOST_KILOBYTES = 10, 300_000


def mutations(count, seed):
    """`count` damaged messages, some spliced from two."""
    source = random.Random(seed)
    for _ in range(count):
        yield mutate(source, source.choice(WHOLE), WHOLE)


def mutate(source, whole, others):
    """Damage: bits flipped; pieces removed, repeated, swapped, or taken from another message."""
    payload = bytearray(whole)
    for _ in range(source.randint(1, 4)):
        start, end = sorted(source.randrange(len(payload) + 1) for _ in range(2))
        end = min(end, start + 64)
        kind = source.randrange(5)
        if kind == 0 and payload:
            payload[start % len(payload)] ^= 1 << source.randrange(8)
        elif kind == 1:
            del payload[start:end]
        elif kind == 2:
            payload[start:start] = payload[start:end]
        elif kind == 3:
            payload[start:end] = source.randbytes(end - start)
        else:
            other = source.choice(others)
            payload[start:end] = other[start:end]
    return bytes(payload)


def reworded(source, whole):
    """A text with some words replaced by unexpected numbers, lists and texts."""
    text = bytearray(whole)
    for _ in range(source.randint(1, 2)):
        places = [place for place, byte in enumerate(text) if byte in b":=,[ "]
        if not places:
            break
        start = source.choice(places) + 1
        end = start
        while end < len(text) and text[end] not in b",}]\n":
            end += 1
        text[start:end] = b" " + source.choice(NUMBERS)
    return bytes(text)


def archives(whole, count, seed):
    """`count` damaged archives: in their own bytes, or in a member, packed again with valid checksums.

    Where there is a manifest, it gives each member the hash that it has by then.
    """
    source = random.Random(seed)
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    for _ in range(count):
        kind = source.randrange(4)
        if kind == 0:
            yield mutate(source, whole, [whole])
        elif kind == 1:
            cut = max(0, len(whole) - 2000)  # where the archive's directory is
            yield whole[:cut] + mutate(source, whole[cut:], [whole])
        else:
            yield packed(_within(source, members, kind == 3), source.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))


def _within(source, members, words):
    """The members, one of them damaged near its start, where headers are."""
    changed = dict(members)
    name = source.choice([*members])
    data = members[name]
    head = reworded(source, data[:2000]) if words else mutate(source, data[:200], [data])
    changed[name] = head + data[2000 if words else 200 :]
    if MANIFEST in changed and name != MANIFEST:
        about = json.loads(changed[MANIFEST])
        about["parts"][name] = hashlib.sha256(changed[name]).hexdigest()
        changed[MANIFEST] = json.dumps(about).encode()
    return changed


def packed(members, kind=zipfile.ZIP_STORED):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", kind) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return buffer.getvalue()


class Watched:
    """Measures reads, which must be fast and use little memory."""

    def __init__(self):
        self._before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        self._slowest, self._said = 0.0, set()

    def read(self, error, reader, *given):
        """Whether the read succeeded. Only `error`, with a one-line text, may be raised."""
        began = process_time()
        try:
            reader(*given)
        except error as raised:
            self._said.add(str(raised))
            return False
        else:
            return True
        finally:
            self._slowest = max(self._slowest, process_time() - began)

    def check(self):
        assert not [text for text in self._said if not text or "\n" in text]
        assert self._slowest < MOST_SECONDS
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - self._before < MOST_KILOBYTES
