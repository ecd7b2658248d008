"""One thread a pool: scoring processes are one a core, and pools that spin against each other were 24 times slower."""

from __future__ import annotations

import os

_SETTINGS = ("OPENBLAS_", "GOTO_", "BLIS_", "MKL_", "OMP_", "KMP_", "GOMP_", "DNNL_", "ONEDNN_", "ATEN_", "NPY_")
POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


def pin_thread_pools() -> None:
    """Tell the numeric libraries of child processes, which read this as they load, to use one thread."""
    for name in POOLS:
        os.environ[name] = "1"


def forget_library_settings() -> None:
    """Let the numeric libraries of child processes choose for this processor, whatever the environment told them.

    A measurement needs it: `OPENBLAS_CORETYPE` alone can halve the rate that a step is held against.
    """
    for name in [each for each in os.environ if each.startswith(_SETTINGS)]:
        del os.environ[name]
