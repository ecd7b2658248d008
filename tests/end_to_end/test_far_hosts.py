"""Three hosts and a router on a fourth, behind join files and links that are slow and cut: the bits.

Each host is a network namespace. Its link to the router is a relay, at which TLS does not end.
"""

import logging
import random
import subprocess
from contextlib import ExitStack, suppress

import pytest

from dreamfleet.common.addons.access.authority import Authority
from tests.support import tasks
from tests.support.hosts import new_host, require_hosts
from tests.support.processes import free_port
from tests.support.relay import Relay
from tests.support.same_bits import evolve, outcome

log = logging.getLogger(__name__)
pytestmark = [pytest.mark.long, pytest.mark.timeout(1800)]
HOSTS, SLOTS = 3, 4
DELAY = 0.05  # seconds that every piece takes on a link, each way
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
                tasks.SLOW_TOY, endpoint=f"tls/{host.address}:{link.port}", inside=host.inside,
            )  # fmt: skip
        for each in self.links:
            each.delay = DELAY
        return coordinator

    def close(self):
        for link in self.links:
            link.close()


def test_links_that_are_slow_and_cut_at_random_cost_no_bit(processes):
    generations, population = 12, 24
    settings = ("--task", tasks.SLOW_TOY, "--population", population, "--episodes", 2, "--evaluate-every", 0,
                "--generations", generations, "--seed", 5)  # fmt: skip
    chance, cuts = random.Random(11), 0
    with ExitStack() as stack:
        cables = [stack.enter_context(new_host()) for _ in range(1 + HOSTS)]
        require_hosts(*cables)
        fleet = FarFleet(processes, cables)
        stack.callback(fleet.close)
        coordinator = fleet.begin("far", *settings)
        coordinator.wait_for_event("generation", number=0, timeout=PATIENCE)
        while coordinator.popen.poll() is None:
            chance.choice(fleet.links).cut()
            cuts += 1
            with suppress(subprocess.TimeoutExpired):
                coordinator.popen.wait(chance.uniform(0.5, 3.0))
        assert coordinator.finish(PATIENCE)[0] == 0, "".join(coordinator.lines[-5:])
    assert outcome(processes, "far") == evolve(processes, "alone", HOSTS, *settings, task=tasks.SLOW_TOY)
    log.info("%d cuts while %d jobs were scored", cuts, generations * population * 2)
    assert cuts >= 10
