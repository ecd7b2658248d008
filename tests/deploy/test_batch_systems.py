"""Workers started by batch systems: the real scripts, a real run, and a drain at the end."""

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.support import tasks
from tests.support.processes import DEADLINE, environment, until

DEPLOY = Path(__file__).parents[2] / "deploy"
BIN = Path(sys.executable).parent
SHELL = {"PATH": f"{BIN}:{os.environ['PATH']}", "DREAMFLEET_LOG_FORMAT": "json"}


@pytest.fixture
def coordinator(processes, random_bundle):
    return processes.coordinator("--bundle", random_bundle.path, "--task", tasks.SLOW_TOY, "--population", 4,
                                 "--episodes", 1, "--evaluate-every", 0, "--generations", 100_000)  # fmt: skip


@pytest.fixture
def cluster_environment(processes, monkeypatch):
    """The environment of a cluster's processes, in which they find our package."""
    monkeypatch.setenv("PYTHONPATH", environment(processes.cache)["PYTHONPATH"])


@pytest.fixture
def start(processes):
    """A function that starts a script, with environment variables as keywords."""
    with ExitStack() as stack:

        def begin(*words, **variables):
            surroundings = environment(processes.cache) | SHELL | variables
            begun = subprocess.Popen([str(each) for each in words], env=surroundings, start_new_session=True,
                                     stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)  # fmt: skip
            stack.enter_context(begun)
            stack.callback(lambda: begun.poll() is None and os.killpg(begun.pid, signal.SIGKILL))
            return begun

        yield begin


def await_slots(processes, count):
    until(lambda: processes.status()["slots"] == count, f"no {count} slots")


def drained(begun):
    """Signal a script to leave and return its output; its workers must have left by themselves."""
    begun.send_signal(signal.SIGTERM)
    said, _ = begun.communicate(timeout=DEADLINE)
    assert begun.returncode == 0, said
    return said


def worker_words(processes):
    return ("--connect", processes.endpoint, "--task", tasks.SLOW_TOY, "--run", "test")


@pytest.mark.slow
def test_slurm_starts_a_worker_that_drains_before_its_limit(processes, coordinator, start):
    """As with `--signal=B:TERM`, only the batch shell gets the signal."""
    variables = {"SLURM_CPUS_PER_TASK": "2", "SLURM_ARRAY_TASK_ID": "7", "SLURMD_NODENAME": "node3"}
    begun = start(DEPLOY / "slurm" / "workers.sh", *worker_words(processes), **variables)
    coordinator.wait_for_event("generation", number=1)
    await_slots(processes, 2)
    assert processes.status()["worker_list"][0]["worker"].startswith("node3-7/")
    drained(begun)
    await_slots(processes, 0)
    near = {"SLURM_JOB_END_TIME": str(int(time.time()) + 95)}
    assert start(DEPLOY / "slurm" / "workers.sh", *worker_words(processes), **variables, **near).wait(DEADLINE) == 0


@pytest.mark.slow
def test_dask_has_a_worker_beside_each_of_its_own(processes, coordinator, start, cluster_environment):
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=2, processes=True, dashboard_address=":0") as cluster:
        begun = start(sys.executable, DEPLOY / "dask" / "workers.py", cluster.scheduler_address,
                      *worker_words(processes))  # fmt: skip
        await_slots(processes, 2)
        cluster.scale(2)
        await_slots(processes, 4)
        coordinator.wait_for_event("generation")
        assert "draining" in drained(begun)
        await_slots(processes, 0)


@pytest.mark.long
def test_ray_has_a_worker_on_each_node(processes, coordinator, start, cluster_environment):
    pytest.importorskip("ray", reason="pip install 'dreamfleet[bench]'")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        begun = start(sys.executable, DEPLOY / "ray" / "workers.py", cluster.address, *worker_words(processes))
        await_slots(processes, 1)
        cluster.add_node(num_cpus=2)
        await_slots(processes, 3)
        coordinator.wait_for_event("generation")
        assert "draining" in drained(begun)
        await_slots(processes, 0)
    finally:
        cluster.shutdown()
