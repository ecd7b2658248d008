"""Three hosts and a router on a fourth, behind join files and links that are slow and cut: the bits, and the time.

Each host is a network namespace. Its link to the router is a relay, at which TLS does not end.
"""

import logging
import random
import sqlite3
import statistics
import subprocess
from contextlib import ExitStack, closing, contextmanager, suppress

import pytest

from dreamfleet.common.addons.access.authority import Authority
from tests.support import tasks
from tests.support.hosts import new_host, require_hosts
from tests.support.processes import free_port, processes_in
from tests.support.relay import Relay
from tests.support.same_bits import outcome

log = logging.getLogger(__name__)
pytestmark = [pytest.mark.long, pytest.mark.timeout(1800)]
HOSTS, SLOTS = 3, 4
TASKS = tasks.SLOW_TOY, tasks.SECOND_TOY
DELAY = 0.05  # seconds that every piece takes on a link, each way
BLOCKS = 3
PATIENCE = 600


class FarFleet:
    """A coordinator here, a router and workers each on a host of their own; all connect out, to the router's relays."""

    def __init__(self, processes, cables):
        self._processes = processes
        self._middle, *self._hosts = cables
        port, access = free_port(), processes.folder / "access"
        near = ["127.0.0.1", *(each.address for each in self._hosts)]
        self.links = [Relay(port, address, far=self._middle.own) for address in near]
        authority = Authority.create(access)
        authority.issue("router", "middle", access / "router.join", hosts=[host.address for host in self._hosts])
        authority.issue("coordinator", "home", access / "home.join")
        authority.issue("worker", "lab", access / "lab.join", connect=[f"tls/{self._middle.own}:{port}"])
        self._access = access
        processes.start("router", "--join", access / "router.join", "--listen", f"tls/{self._middle.own}:{port}",
                        inside=self._middle.inside).wait_for_event("begin")  # fmt: skip

    def begin(self, name, *settings):
        home, *links = self.links
        at = ("--join", self._access / "home.join", "--connect", f"tls/127.0.0.1:{home.port}")
        coordinator = self._processes.coordinator(*settings, name=name, at=at)
        for number, (host, link) in enumerate(zip(self._hosts, links, strict=True)):
            self._processes.worker(
                "--join", self._access / "lab.join", "--run", name, "--name", f"h{number}", "--slots", SLOTS, "--task",
                *TASKS, endpoint=f"tls/{host.address}:{link.port}", inside=host.inside,
            )  # fmt: skip
        for each in self.links:
            each.delay = DELAY
        return coordinator

    def close(self):
        for link in self.links:
            link.close()


@contextmanager
def far_fleet(processes):
    with ExitStack() as stack:
        cables = [stack.enter_context(new_host()) for _ in range(1 + HOSTS)]
        require_hosts(*cables)
        fleet = FarFleet(processes, cables)
        stack.callback(fleet.close)
        yield fleet


def begin_near(processes, name, *settings):
    """The same workers on this host, at a coordinator that is its own router, without certificates."""
    coordinator = processes.coordinator(*settings, name=name)
    for number in range(HOSTS):
        processes.worker("--run", name, "--name", f"h{number}", "--slots", SLOTS, "--task", *TASKS)
    return coordinator


def test_links_that_are_slow_and_cut_at_random_cost_no_bit(processes):
    generations, population = 12, 24
    settings = ("--task", tasks.SLOW_TOY, "--population", population, "--episodes", 2, "--evaluate-every", 0,
                "--generations", generations, "--seed", 5)  # fmt: skip
    chance, cuts = random.Random(11), 0
    with far_fleet(processes) as fleet:
        coordinator = fleet.begin("far", *settings)
        coordinator.wait_for_event("generation", number=0, timeout=PATIENCE)
        while coordinator.popen.poll() is None:
            chance.choice(fleet.links).cut()
            cuts += 1
            with suppress(subprocess.TimeoutExpired):
                coordinator.popen.wait(chance.uniform(0.5, 3.0))
        assert coordinator.finish(PATIENCE)[0] == 0, "".join(coordinator.lines[-5:])
    assert begin_near(processes, "alone", *settings).finish(PATIENCE)[0] == 0
    assert outcome(processes, "far") == outcome(processes, "alone")
    log.info("%d cuts while %d jobs were scored", cuts, generations * population * 2)
    assert cuts >= 10


def efficiency(processes, name):
    """Seconds of accepted jobs over slots x time, from the first generation's end to the last one's."""
    with closing(sqlite3.connect(processes.runs / name / "journal.sqlite")) as journal:
        first, last = journal.execute("SELECT min(closed), max(closed) FROM generation").fetchone()
        (done,) = journal.execute("SELECT sum(seconds) FROM result WHERE generation > 0").fetchone()
    return done / (HOSTS * SLOTS * (last - first))


def test_jobs_of_a_second_keep_slots_behind_slow_links_as_busy_as_on_one_host(tmp_path):
    population, generations = 4 * HOSTS * SLOTS, 6
    settings = ("--task", tasks.SECOND_TOY, "--population", population, "--episodes", 1, "--evaluate-every", 0,
                "--generations", generations, "--seed", 5)  # fmt: skip
    near, far = [], []
    for block in range(BLOCKS):
        with processes_in(tmp_path / f"near-{block}") as processes:
            assert begin_near(processes, "near", *settings).finish(PATIENCE)[0] == 0
            near.append(efficiency(processes, "near"))
        with processes_in(tmp_path / f"far-{block}") as processes, far_fleet(processes) as fleet:
            assert fleet.begin("far", *settings).finish(PATIENCE)[0] == 0
            far.append(efficiency(processes, "far"))
    ratio = statistics.median(b / a for a, b in zip(near, far, strict=True))
    log.info("busy: here %s, far %s; median ratio %.3f", *(", ".join(f"{each:.3f}" for each in one)
                                                          for one in (near, far)), ratio)  # fmt: skip
    assert ratio >= 0.9
