"""How many cores this process may use: fewer than the host has where a container or a batch system says so."""

from __future__ import annotations

import math
import os
from contextlib import suppress
from pathlib import Path

_GROUPS, _OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def cores(groups: Path = _GROUPS, own: Path = _OWN) -> int:
    """At least 1: those that the scheduler lets it run on, and no more than its control groups give it the time of.

    Half a core's time counts as a core. `groups` is where Linux shows control groups, `own` which ones are ours.
    """
    may = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quotas = [quota for folder in _folders(groups, own) if (quota := _quota(folder)) is not None]
    return max(1, min([may, *(math.ceil(quota) for quota in quotas)]))


def _folders(groups: Path, own: Path) -> list[Path]:
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


def _quota(folder: Path) -> float | None:
    """Cores' worth of time that a control group has; `None`: as much as there is."""
    with suppress(OSError, ValueError, ZeroDivisionError):  # version 2: "max 100000", or "150000 100000"
        quota, period = (folder / "cpu.max").read_text().split()
        return None if quota == "max" else int(quota) / int(period)
    with suppress(OSError, ValueError, ZeroDivisionError):  # version 1: -1, or microseconds
        given, each = (int((folder / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period"))
        return given / each if given > 0 else None
    return None
