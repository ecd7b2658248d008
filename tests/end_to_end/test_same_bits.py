"""The promise: who scored, and who died meanwhile, changes no bit; a host of other bits is of another class.

Tests common/protocol/host_classes.py, coordinator/jobs/generation.py, coordinator/run/run.py and
worker/scoring/host_class_probe.py.
"""

import json
import os
import signal
import subprocess
import sys

import pytest

from dreamfleet.common.runs.run_folder import open_run
from tests.support.processes import DEADLINE
from tests.support.same_bits import EPISODES, SETTINGS, check_replay, evolve, outcome

DREAMT = ("--task", "dream", "--horizon", 100, "--evaluate-every", 2, "--evaluation-episodes", 2,
          "--confirm-episodes", 2)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("flags", [("--evaluate-every", 0), DREAMT], ids=["driven", "dreamt"])
def test_one_worker_and_three_of_which_one_is_killed_give_the_same_bits(processes, flags):
    alone = evolve(processes, "alone", 1, *SETTINGS, *flags)
    coordinator = processes.coordinator(*SETTINGS, *flags, name="three")
    workers = [processes.worker("--run", "three", "--name", f"w{number}") for number in range(3)]
    coordinator.wait_for_event("generation", number=0)
    os.kill(workers[1].popen.pid, signal.SIGKILL)  # it has jobs of the next one by now
    assert coordinator.finish()[0] == 0
    assert outcome(processes, "three") == alone
    check_replay(processes, "alone", "2/3", EPISODES)


OTHER_KERNEL = ("env", "OPENBLAS_CORETYPE=Nehalem")
PRODUCT = "import numpy as np; a = np.sin(np.arange(24 * 16)).astype('f4').reshape(16, 24); print((a @ a[3]).tobytes())"


def product(where):
    return subprocess.check_output([*where, sys.executable, "-c", PRODUCT], timeout=DEADLINE)


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
    coordinator = processes.resume("test", "--generations", 2)
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
    _, out, err = replayed("0/0", (), "--json")
    found = json.loads(out)
    assert found["unchecked"] + sum(each["stored"] == each["replayed"] for each in found["episodes"]) == 2
    if found["unchecked"]:
        assert err
        assert replayed("0/0", (), "--tolerance", 1000)[0] == 0
