"""What this process may use: cores, open files, and one thread for each numeric pool."""

from __future__ import annotations

import math
import os
import resource
from contextlib import suppress
from pathlib import Path

_GROUPS, _OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def usable_cores(groups: Path = _GROUPS, own: Path = _OWN) -> int:
    """At least 1: those that the scheduler lets it run on, and no more than its control groups give it the time of.

    Half a core's time counts as a core. `groups` is where Linux shows control groups, `own` which ones are ours.
    """
    may = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quotas = [quota for folder in _cgroup_folders(groups, own) if (quota := _cpu_quota(folder)) is not None]
    return max(1, min([may, *(math.ceil(quota) for quota in quotas)]))


def _cgroup_folders(groups: Path, own: Path) -> list[Path]:
    """Those of our control group and all above it: the smallest quota holds. A container sees its own as the root."""
    found = [groups, groups / "cpu"]
    with suppress(OSError):
        for line in own.read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            root = groups / "cpu" if "cpu" in controllers.split(",") else groups
            if controllers in ("", "cpu", "cpu,cpuacct", "cpuacct,cpu"):
                below = Path(path.lstrip("/"))
                found += [root / each for each in (below, *below.parents)]
    return found


def _cpu_quota(folder: Path) -> float | None:
    """Cores' worth of time that a control group has; `None`: as much as there is."""
    with suppress(OSError, ValueError, ZeroDivisionError):  # version 2: "max 100000", or "150000 100000"
        quota, period = (folder / "cpu.max").read_text().split()
        return None if quota == "max" else int(quota) / int(period)
    with suppress(OSError, ValueError, ZeroDivisionError):  # version 1: -1, or microseconds
        given, each = (int((folder / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period"))
        return given / each if given > 0 else None
    return None


WANTED_FILES = 65_536
RESERVED_FILES = 64  # for ourselves: journal, world model, controller, Zenoh's own


def raise_open_file_limit() -> None:
    """As many as the host allows without asking: the usual 1024 is a habit for programs that use `select`."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = WANTED_FILES if hard == resource.RLIM_INFINITY else min(hard, WANTED_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def connection_budget() -> int:
    """How many connections leave enough for ourselves."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return max((WANTED_FILES if soft == resource.RLIM_INFINITY else soft) - RESERVED_FILES, 8)


_SETTINGS = ("OPENBLAS_", "GOTO_", "BLIS_", "MKL_", "OMP_", "KMP_", "GOMP_", "DNNL_", "ONEDNN_", "ATEN_", "NPY_")
POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


def pin_thread_pools() -> None:
    """Tell the numeric libraries of child processes, which read this as they load, to use one thread."""
    for name in POOLS:
        os.environ[name] = "1"


def clear_library_settings() -> None:
    """Let the numeric libraries of child processes choose for this processor, whatever the environment told them.

    A measurement needs it: `OPENBLAS_CORETYPE` alone can halve the rate that a step is held against.
    """
    for name in [each for each in os.environ if each.startswith(_SETTINGS)]:
        del os.environ[name]
