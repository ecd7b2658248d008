"""A host's fingerprint: CPU features, libc, and the versions of the packages that compute a fitness.

Equal fingerprints do not guarantee equal bits; host classes compare the results themselves
(`common/protocol/host_classes.py`). Pages: mixed-hosts.md, determinism.md.
"""

import platform
from functools import cache
from pathlib import Path

from dreamfleet.common.host.packages import package_version

# The packages of CarRacing and its dream; a run whose task names no others has these.
NUMERIC_PACKAGES = ("numpy", "onnxruntime", "gymnasium", "pygame-ce", "box2d", "box2d-py")
# Instruction sets between which the inference kernels choose at run time.
CPU_FEATURES = ("sse4_1", "avx", "avx2", "fma", "f16c", "avx512f", "avx512bw", "avx512vl", "avx512_vnni", "avx512_bf16",
                "avx_vnni", "amx_tile", "asimd", "asimddp", "sve", "i8mm", "bf16")  # fmt: skip


def cpu_features(cpuinfo: Path = Path("/proc/cpuinfo")) -> tuple[str, ...]:
    """The `CPU_FEATURES` of this processor; empty if it does not report any."""
    try:
        text = cpuinfo.read_text()
    except OSError:
        return ()
    line = next((line for line in text.splitlines() if line.startswith(("flags", "Features"))), "")
    present = set(line.split())
    return tuple(feature for feature in CPU_FEATURES if feature in present)


@cache
def fingerprint(packages: tuple[str, ...] = NUMERIC_PACKAGES, torch_device: str = "") -> str:
    """One line that is equal on hosts that are expected to compute equal bits. Takes 5 ms, and is cached.

    `packages` are those that a fitness of the run's task depends on; other packages do not matter. A worker's
    `torch_device`, on which it dreams, is named with torch's version.
    """
    libc, libc_version = platform.libc_ver()
    versions = [f"{name}-{found}" for name in packages if (found := package_version(name))]
    features = "+".join(cpu_features()) or platform.processor() or "unknown"
    dreams = [f"dreams-on-{torch_device}", f"torch-{package_version('torch')}"] if torch_device else []
    # The device is named early: a status cuts long fingerprints.
    return " ".join([platform.machine(), *dreams, features, f"{libc or platform.system()}-{libc_version}", *versions])
