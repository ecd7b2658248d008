"""Resource limits of this process: cores, memory, open files, and the threads of numeric libraries."""

import errno
import math
import os
import resource
import sys
import threading
from contextlib import suppress
from pathlib import Path

from dreamfleet.common.errors import DreamfleetError

_CGROUPS, _OWN_CGROUP, _MEMINFO = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup"), Path("/proc/meminfo")


def usable_cores(groups: Path = _CGROUPS, own: Path = _OWN_CGROUP) -> int:
    """The number of cores in the scheduler's affinity mask, bounded by cgroup CPU quotas (rounded up); at least 1.

    `groups` is the cgroup file system, `own` the file that lists this process's cgroups.
    """
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quotas = [quota for folder in _cgroup_folders(groups, own, "cpu") if (quota := _cpu_quota(folder)) is not None]
    return max(1, min([allowed, *(math.ceil(quota) for quota in quotas)]))


def usable_memory(groups: Path = _CGROUPS, own: Path = _OWN_CGROUP, host: Path = _MEMINFO) -> int:
    """The bytes that this process can have at most: memory and swap of the host, cgroup limits, `ulimit -v`.

    Other processes may hold some of them. `host` is the file that lists the host's memory.
    """
    limits = [
        limit for folder in _cgroup_folders(groups, own, "memory") if (limit := _memory_limit(folder)) is not None
    ]
    address_space, _ = resource.getrlimit(resource.RLIMIT_AS)
    if address_space != resource.RLIM_INFINITY:
        limits.append(address_space)
    with suppress(OSError, ValueError, KeyError):
        sizes = dict(line.split(":") for line in host.read_text().splitlines())
        limits.append(sum(int(sizes[name].split()[0]) * 1024 for name in ("MemTotal", "SwapTotal")))
    return min(limits, default=sys.maxsize)


def _memory_limit(folder: Path) -> int | None:
    """A cgroup's memory limit in bytes; `None` if unlimited."""
    for name in ("memory.max", "memory.limit_in_bytes"):  # versions 2 and 1
        with suppress(OSError, ValueError):  # "max", or bytes
            return int((folder / name).read_text())
    return None


def _cgroup_folders(groups: Path, own: Path, controller: str) -> list[Path]:
    """The folders of this process's cgroup and its parents: all their limits apply."""
    found = [groups, groups / controller]
    with suppress(OSError):
        for line in own.read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            root = groups / controller if controller in controllers.split(",") else groups
            if not controllers or controller in controllers.split(","):
                below = Path(path.lstrip("/"))
                found += [root / each for each in (below, *below.parents)]
    return found


def _cpu_quota(folder: Path) -> float | None:
    """A cgroup's CPU quota in cores; `None` if unlimited."""
    with suppress(OSError, ValueError, ZeroDivisionError):  # version 2: "max 100000", or "150000 100000"
        quota, period = (folder / "cpu.max").read_text().split()
        return None if quota == "max" else int(quota) / int(period)
    with suppress(OSError, ValueError, ZeroDivisionError):  # version 1: -1, or microseconds
        quota_us, period_us = (int((folder / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period"))
        return quota_us / period_us if quota_us > 0 else None
    return None


WANTED_FILES = 65_536  # docs/how-to/monitor.md describes this limit and the next one
RESERVED_FILES = 64  # for everything but connections: journal, world model, controller, Zenoh's own


def raise_open_file_limit() -> None:
    """Raise the soft limit of open files to the hard one, at most `WANTED_FILES`; the usual 1024 is for `select`."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = WANTED_FILES if hard == resource.RLIM_INFINITY else min(hard, WANTED_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def connection_budget() -> int:
    """The number of connections that leaves `RESERVED_FILES` under the limit of open files."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return max((WANTED_FILES if soft == resource.RLIM_INFINITY else soft) - RESERVED_FILES, 8)


SESSION_FILES = 24  # a network session opens some ten, and its first connections
SESSION_THREADS = 16


def check_room_for_session() -> None:
    """`DreamfleetError` if no network session fits: Zenoh would crash where a descriptor or a thread is lacking."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft - _open_files() < SESSION_FILES:
        raise DreamfleetError(
            f"this process may open only {soft} files, too few for a network session: raise the limit "
            "(`ulimit -n 1024`)"
        )
    done = threading.Event()
    threads = [threading.Thread(target=done.wait) for _ in range(SESSION_THREADS)]
    try:
        for each in threads:
            each.start()
    except RuntimeError as error:
        raise DreamfleetError(
            "this user may start too few threads for a network session: end other processes, or raise the limit "
            "(`ulimit -u`), or that of its memory (`ulimit -v`)"
        ) from error
    finally:
        done.set()
        for each in threads:
            if each.ident is not None:
                each.join()


def _open_files() -> int:
    """The number of descriptors in use; 0 if unknown."""
    try:
        return sum(1 for _ in Path("/dev/fd").iterdir())
    except OSError as error:
        return WANTED_FILES if error.errno in (errno.EMFILE, errno.ENFILE) else 0


_SETTINGS = ("OPENBLAS_", "GOTO_", "BLIS_", "MKL_", "OMP_", "KMP_", "GOMP_", "DNNL_", "ONEDNN_", "ATEN_", "NPY_")
POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


def pin_thread_pools() -> None:
    """Make the numeric libraries of child processes use one thread; they read the environment as they load."""
    for name in POOLS:
        os.environ[name] = "1"


def clear_library_settings() -> None:
    """Remove settings of numeric libraries from the environment, so that child processes use the defaults.

    For measurements: `OPENBLAS_CORETYPE` alone can halve the speed of a matrix product.
    """
    for name in [each for each in os.environ if each.startswith(_SETTINGS)]:
        del os.environ[name]
