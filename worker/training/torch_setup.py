"""What a training asks of its process before torch is loaded, so that it leaves the processor to whoever can use it."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager

# Of glibc's malloc.h: what to set, and to what.
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX = -1, -2, -4
LARGEST, GROWTH = 2**31 - 1, 1 << 28  # bytes


def configure_process() -> None:
    """Let threads that wait sleep, and the heap keep what is freed; no result depends on either.

    Threads that spin until the others are through take the time of whatever else runs: beside one busy process an
    update of the article's VAE on two threads took 0.61 s, and 0.38 s where they sleep; alone it is the same. Each
    update's tensors were given back to the system and asked for again, page by page: an eighth of the time
    of a VAE's update, a quarter of an MDN-RNN's (docs/measurements.md).
    What the user set in the environment stays.
    """
    os.environ["OMP_WAIT_POLICY"] = os.environ.get("OMP_WAIT_POLICY") or "PASSIVE"
    if not any(name.startswith("MALLOC_") for name in os.environ):
        _keep_freed_memory()


def _keep_freed_memory() -> None:
    """Where the C library is glibc; elsewhere nothing is known to be needed."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, TypeError, AttributeError):
        return
    mallopt(M_MMAP_MAX, 0)
    mallopt(M_TRIM_THRESHOLD, LARGEST)
    mallopt(M_TOP_PAD, GROWTH)


@contextmanager
def on_one_thread() -> Iterator[None]:
    """Inside, bits do not depend on a host's cores, and steps too small to share take a fraction of the time."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
