"""Workers on hosts of their own, one of whose cables is pulled."""

import time

import pytest

from tests.support import tasks
from tests.support.hosts import new_host, require_hosts
from tests.support.processes import DEADLINE
from tests.support.same_bits import outcome

GENERATIONS, POPULATION = 16, 8


@pytest.fixture
def hosts():
    with new_host() as first, new_host() as second:
        require_hosts(first, second)
        yield first, second


def slots(processes):
    return sum(status.slots for status in processes.statuses())


@pytest.mark.slow
def test_a_host_that_is_cut_off_costs_no_bit_and_comes_back(processes, hosts, random_bundle):
    settings = (
        "--bundle", random_bundle.path, "--population", POPULATION, "--episodes", 1, "--generations", GENERATIONS,
        "--evaluate-every", 0,
    )  # fmt: skip
    near = [f"tcp/{host.address}:{processes.port}" for host in hosts]
    coordinator = processes.start(
        "coordinator", "--run", "two", "--runs-dir", processes.runs, "--beat", 0.2,
        "--listen", processes.endpoint, *near, "--insecure", *settings, "--task", tasks.SLOW_TOY,
    )  # fmt: skip
    coordinator.wait_for_event("begin")
    for number, host in enumerate(hosts):
        processes.worker(
            "--run", "two", "--task", tasks.SLOW_TOY, "--name", f"h{number}", endpoint=near[number], inside=host.inside
        ).wait_for_event("joined")
    coordinator.wait_for_event("generation", number=1)
    hosts[0].unplug()
    coordinator.wait_for_event("silent")
    hosts[0].plug()
    deadline = time.monotonic() + DEADLINE
    while slots(processes) < len(hosts):
        assert time.monotonic() < deadline, "the host came back and its worker did not"
    code, _ = coordinator.finish()
    assert code == 0

    alone = processes.coordinator(*settings, "--task", tasks.TOY, name="alone")
    processes.worker("--run", "alone", "--task", tasks.TOY)
    code, _ = alone.finish()
    assert code == 0
    assert outcome(processes, "two") == outcome(processes, "alone")
