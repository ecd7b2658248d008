"""What a host is, in one line: CPU features, libc, and the versions of the packages that compute a fitness.

Nothing guarantees equal bits across instruction sets or versions; whether two hosts have them is what their classes say
(`common/protocol/host_classes.py`).
"""

from __future__ import annotations

import platform
from functools import cache
from pathlib import Path

from dreamfleet.common.host.packages import package_version

# Of CarRacing and its dream, and of runs from before tasks said which.
NUMERIC_PACKAGES = ("numpy", "onnxruntime", "gymnasium", "pygame-ce", "box2d", "box2d-py")
# The instruction sets that the inference kernels choose between at run time.
CPU_FEATURES = ("sse4_1", "avx", "avx2", "fma", "f16c", "avx512f", "avx512bw", "avx512vl", "avx512_vnni", "avx512_bf16",
                "avx_vnni", "amx_tile", "asimd", "asimddp", "sve", "i8mm", "bf16")  # fmt: skip


def cpu_features(cpuinfo: Path = Path("/proc/cpuinfo")) -> tuple[str, ...]:
    """The features of `CPU_FEATURES` that this processor announces; empty where it does not say."""
    try:
        text = cpuinfo.read_text()
    except OSError:
        return ()
    line = next((line for line in text.splitlines() if line.startswith(("flags", "Features"))), "")
    present = set(line.split())
    return tuple(feature for feature in CPU_FEATURES if feature in present)


@cache
def fingerprint(packages: tuple[str, ...] = NUMERIC_PACKAGES) -> str:
    """One line that is equal on hosts that are expected to compute equal bits; it costs 5 ms to find out, once.

    `packages` are those that a fitness of the run's task may depend on: what else is installed splits no fleet.
    """
    libc, libc_version = platform.libc_ver()
    versions = [f"{name}-{found}" for name in packages if (found := package_version(name))]
    features = "+".join(cpu_features()) or platform.processor() or "unknown"
    return " ".join([platform.machine(), features, f"{libc or platform.system()}-{libc_version}", *versions])
