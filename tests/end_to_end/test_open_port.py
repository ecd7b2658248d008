"""Who does what at an open port, without certificates: it is refused or bounded, and the run ends with the same bits.

The attacker has a session of Zenoh and nothing else: it overhears names, lives, nonces, batches and fingerprints. What
rules cannot hold off is not here: docs/explanation/threats.md names it.
"""

import socket

import pytest

from dreamfleet.common.transport.session import Network
from tests.support import tasks
from tests.support.attacks import OPEN, SETTINGS, attacking, outcome


def connects_without_end(evil, number):
    if number < 5:
        host, port = evil.endpoint.partition("/")[2].split(":")
        for _ in range(200):
            socket.create_connection((host, int(port))).close()


ACTIONS = [*OPEN, connects_without_end]


def harmed(processes, random_bundle, *actions):
    coordinator = processes.coordinator("--bundle", random_bundle.path, *SETTINGS)
    with attacking(Network(connect=(processes.endpoint,)), *actions) as evil:
        processes.worker("--task", tasks.SLOW_TOY, "--name", "own")
        assert coordinator.finish()[0] == 0
    assert not evil.steered
    return evil, coordinator


@pytest.mark.slow
def test_all_at_once_change_no_bit(processes, random_bundle, unharmed):
    evil, coordinator = harmed(processes, random_bundle, *ACTIONS)
    assert outcome(processes) == unharmed, "\n".join(coordinator.lines)
    assert evil.dropped.keys() >= {
        "result of an unknown worker", "result of a job that was not given",
        "result of another fingerprint than its worker's", "lease with more steps than a job has",
    }  # fmt: skip
    assert not coordinator.events("paused")


@pytest.mark.long
@pytest.mark.parametrize("action", ACTIONS, ids=lambda action: action.__name__)
def test_each_alone_changes_no_bit(processes, random_bundle, unharmed, action):
    harmed(processes, random_bundle, action)
    assert outcome(processes) == unharmed
