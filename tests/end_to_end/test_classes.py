"""Hosts whose bits differ: any may score, each result names its host's class, and a strict run keeps to one."""

import hashlib
import json
import subprocess
import sys

import pytest

from dreamfleet.common.runs.run_folder import open_run
from tests.support import tasks
from tests.support.processes import DEADLINE

ODD = ("env", f"{tasks.ROUNDING}=1")  # a host on which a sum comes out otherwise, in its last bit
FURTHER = ("--generations", 2)
OTHER_KERNEL = ("env", "OPENBLAS_CORETYPE=Nehalem")
PRODUCT = (
    "import hashlib, numpy as np; a = np.sin(np.arange(24 * 16)).astype('f4').reshape(16, 24);"
    "print(hashlib.sha256((a @ a[3]).tobytes()).hexdigest())"
)


@pytest.mark.slow
def test_a_strict_run_refuses_another_class_and_stays_strict_when_resumed(processes, small):
    def work(inside=()):
        return processes.worker("--task", tasks.ROUNDED, "--name", "own", inside=inside)

    coordinator = processes.coordinator(*small, "--task", tasks.ROUNDED, "--generations", 1, "--strict")
    first = work()
    assert coordinator.finish()[0] == 0
    first.end()  # else it would score the next generation
    coordinator = processes.resume("test", *FURTHER)
    odd = work(ODD)
    assert "--no-strict" in odd.wait_for_event("refused")["message"]
    coordinator.wait_for_event("left")
    coordinator.end()
    coordinator = processes.resume("test", *FURTHER, "--no-strict")
    work(ODD)
    assert coordinator.finish()[0] == 0
    with open_run(processes.runs, "test") as run:
        assert run.classes.total == 2
        assert "strict" not in json.loads(run.fact("network"))


def product(where):
    done = subprocess.run([*where, sys.executable, "-c", PRODUCT], capture_output=True, check=True, timeout=DEADLINE)
    return hashlib.sha256(done.stdout).hexdigest()


@pytest.mark.slow
def test_another_kernel_of_openblas_is_another_class_whose_results_are_replayed_there(processes):
    """Real arithmetic, no test's: OpenBLAS with and without fused products, under gymnasium's BipedalWalker."""
    if product(()) == product(OTHER_KERNEL):
        pytest.skip("OpenBLAS rounds the same with every kernel that this processor has")
    coordinator = processes.coordinator(
        "--task", "gym:BipedalWalker-v3", "--population", 4, "--episodes", 2, "--horizon", 100, "--sigma0", 1.0,
        "--evaluate-every", 0, "--generations", 1,
    )  # fmt: skip
    first = processes.worker(inside=OTHER_KERNEL)
    assert coordinator.finish()[0] == 0
    first.end()
    coordinator = processes.resume("test", *FURTHER)
    processes.worker()
    assert coordinator.finish()[0] == 0
    with open_run(processes.runs, "test") as run:
        assert run.classes.total == 2

    def replayed(candidate, where=(), *more):
        words = ("verify", "candidate", "test", "--runs-dir", processes.runs, "--candidate", candidate, *more)
        replay = processes.start(*words, inside=where)
        code, out = replay.finish()
        return code, out, "".join(replay.lines)

    code, out, err = replayed("1/0")
    assert (code, out.count("same bits"), err) == (0, 2, "")
    code, out, _ = replayed("0/0", OTHER_KERNEL)
    assert (code, out.count("same bits")) == (0, 2)
    code, out, err = replayed("0/0")
    assert "DIFFERS" not in out
    assert out.count("not checkable here") + out.count("same bits") == 2
    if "not checkable here" in out:
        assert err
        assert replayed("0/0", (), "--tolerance", 1000)[0] == 0
