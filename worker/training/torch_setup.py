"""Configure a process before torch is loaded: threads and heap; and run torch on one thread."""

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX = -1, -2, -4  # parameters of mallopt, from glibc's malloc.h
LARGEST, GROWTH = 2**31 - 1, 1 << 28  # bytes


def configure_process() -> None:
    """Let waiting threads sleep, and let the heap keep freed memory; results do not depend on either.

    Threads that spin while they wait take time from other processes: beside one busy process an update of the article's
    VAE on two threads took 0.61 s, and 0.38 s with sleeping threads; alone the times are equal. Returning each update's
    memory to the system and requesting it again cost an eighth of a VAE's update and a quarter of an MDN-RNN's
    (docs/lab/measurements.md). Environment variables that the user has set take precedence.
    """
    os.environ["OMP_WAIT_POLICY"] = os.environ.get("OMP_WAIT_POLICY") or "PASSIVE"
    if not any(name.startswith("MALLOC_") for name in os.environ):
        _keep_freed_memory()


def _keep_freed_memory() -> None:
    """Set glibc's allocator; do nothing with another C library."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, TypeError, AttributeError):
        return
    mallopt(M_MMAP_MAX, 0)
    mallopt(M_TRIM_THRESHOLD, LARGEST)
    mallopt(M_TOP_PAD, GROWTH)


@contextmanager
def on_one_thread() -> Iterator[None]:
    """Run torch on one thread: bits do not depend on the host's cores, and small steps are much faster."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
