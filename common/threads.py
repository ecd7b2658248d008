"""One thread a pool: scoring processes are one a core, and pools that spin against each other were 24 times slower."""

from __future__ import annotations

import os

_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


def pin_thread_pools() -> None:
    """Tell the numeric libraries of child processes, which read this as they load, to use one thread."""
    for name in _POOLS:
        os.environ[name] = "1"
