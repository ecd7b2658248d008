"""Messages that something went wrong with."""

import random

from dreamfleet.common.codec import encode
from tests.support.samples import MSGPACK

WHOLE = [encode(message) for message in MSGPACK.values()]


def mutations(count, seed):
    """`count` damaged messages: bits flipped, pieces cut out, doubled, swapped, or taken from another message."""
    source = random.Random(seed)
    for _ in range(count):
        payload = bytearray(source.choice(WHOLE))
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
                other = source.choice(WHOLE)
                payload[start:end] = other[start:end]
        yield bytes(payload)
