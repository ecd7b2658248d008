"""Hosts whose bits differ: any may score, each result names its host's class, and a strict run keeps to one."""

import hashlib
import json
import subprocess
import sys

import pytest

from dreamfleet.common.runs.run_folder import open_run
from tests.support import tasks
from tests.support.processes import DEADLINE, call_here

ODD = ("env", f"{tasks.ROUNDING}=1")  # a host on which a sum comes out otherwise, in its last bit
GO_ON = "coordinator", "--resume", "test", "--generations", 2
OTHER_KERNEL = ("env", "OPENBLAS_CORETYPE=Nehalem")
PRODUCT = (
    "import hashlib, numpy as np; a = np.sin(np.arange(24 * 16)).astype('f4').reshape(16, 24);"
    "print(hashlib.sha256((a @ a[3]).tobytes()).hexdigest())"
)


@pytest.fixture
def settings(random_bundle):
    return ("--bundle", random_bundle.path, "--population", 4, "--episodes", 2, "--evaluate-every", 0,
            "--task", tasks.ROUNDED)  # fmt: skip


def own(processes, *more, **where):
    return processes.worker("--task", tasks.ROUNDED, "--name", "own", *more, **where)


def one_after_the_other(processes, settings, first, second):
    """The first worker scores generation 0, the second one generation 1."""
    coordinator = processes.coordinator(*settings, "--generations", 1)
    started = first()
    assert coordinator.finish()[0] == 0
    getattr(started, "popen", started).kill()  # else it would score the next generation too
    coordinator = processes.start(*GO_ON, "--runs-dir", processes.runs)
    second()
    assert coordinator.finish()[0] == 0
    with open_run(processes.runs, "test") as run:
        return run.classes


@pytest.mark.slow
def test_a_strict_run_refuses_another_class_and_stays_strict_when_resumed(processes, settings):
    coordinator = processes.coordinator(*settings, "--generations", 1, "--strict")
    first = own(processes)
    assert coordinator.finish()[0] == 0
    first.end()  # else it would score the next generation
    resumed = *GO_ON, "--runs-dir", processes.runs
    coordinator = processes.start(*resumed)
    odd = own(processes, inside=ODD)
    assert "--no-strict" in odd.wait_for_event("refused")["message"]
    coordinator.wait_for_event("left")
    coordinator.end()
    coordinator = processes.start(*resumed, "--no-strict")
    own(processes, inside=ODD)
    assert coordinator.finish()[0] == 0
    with open_run(processes.runs, "test") as run:
        assert run.classes.total == 2
        assert "strict" not in json.loads(run.fact("network"))


@pytest.mark.slow
def test_status_runs_show_and_list_name_the_classes_of_results(processes, settings):
    coordinator = processes.coordinator(*settings, "--generations", 1000)
    odd = own(processes, inside=ODD)
    coordinator.wait_for_event("generation", number=0)
    while "classes" not in (status := processes.status()):
        pass  # the status is of a moment before
    assert status["classes"]["total"] == 1
    odd.end()
    own(processes)
    while (status := processes.status())["classes"]["total"] < 2:
        pass
    assert len({each["host_class"] for each in status["worker_list"]} - {""}) >= 1
    _, out, _ = call_here("runs", "show", "test", "--runs-dir", processes.runs)
    for each in status["classes"]["largest"]:
        assert each["host_class"] in out
    (row,) = json.loads(call_here("runs", "list", "--runs-dir", processes.runs, "--json")[1])
    assert row["classes"] == 2


def product(where):
    done = subprocess.run([*where, sys.executable, "-c", PRODUCT], capture_output=True, check=True, timeout=DEADLINE)
    return hashlib.sha256(done.stdout).hexdigest()


@pytest.mark.slow
def test_another_kernel_of_openblas_is_another_class_whose_results_are_replayed_there(processes):
    """Real arithmetic, no test's: OpenBLAS with and without fused products, under gymnasium's BipedalWalker."""
    if product(()) == product(OTHER_KERNEL):
        pytest.skip("OpenBLAS rounds the same with every kernel that this processor has")
    settings = ("--task", "gym:BipedalWalker-v3", "--population", 4, "--episodes", 2, "--horizon", 100, "--sigma0", 1.0,
                "--evaluate-every", 0)  # fmt: skip
    classes = one_after_the_other(processes, settings, lambda: processes.worker(inside=OTHER_KERNEL), processes.worker)
    assert classes.total == 2

    def replayed(candidate, where=(), *more):
        replay = processes.start(
            "verify", "candidate", "test", "--runs-dir", processes.runs, "--candidate", candidate, *more, inside=where
        )
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
