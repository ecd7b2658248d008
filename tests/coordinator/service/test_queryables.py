"""Queries of the status over a coordinator's only link: they delay nothing else there, and few of them wait."""

from contextlib import ExitStack
from logging import getLogger
from queue import SimpleQueue
from threading import Event

import pytest
import zenoh

from dreamfleet.common.host.error_counter import ErrorCounter
from dreamfleet.common.protocol import keys
from dreamfleet.common.transport.network import Network
from dreamfleet.common.transport.session import open_session
from dreamfleet.coordinator.service import queryables
from dreamfleet.coordinator.service.queryables import MOST_WAITING, declare_status
from tests.support.processes import DEADLINE, free_port, until
from tests.support.served import snapshot

OTHER = "dreamfleet/other"


class Coordinator:
    """A client of a router that answers for the run `night`, once it may, and hears `OTHER`."""

    def __init__(self, endpoint, stack):
        self.shown, self.may_answer, self.heard, self.encoded = snapshot(), Event(), SimpleQueue(), []
        stack.enter_context(open_session(Network(listen=(endpoint,))))
        self.session, self.asking = (stack.enter_context(open_session(Network(connect=(endpoint,)))) for _ in range(2))
        self.declared = [
            self.session.declare_subscriber(OTHER, zenoh.handlers.Callback(self.heard.put, indirect=False)),
            *declare_status(self.session, "night", lambda: self.shown, ErrorCounter(getLogger(__name__))),
        ]
        until(lambda: self.asking.declare_querier(keys.status("night")).matching_status.matching)
        stack.callback(self.may_answer.set)

    def ask(self, replies, part="", parameters=""):
        handler = zenoh.handlers.Callback(replies.put, indirect=False)
        self.asking.get(f"{keys.status('night', part)}?{parameters}", handler, timeout=DEADLINE)


@pytest.fixture
def coordinator(monkeypatch):
    encode = queryables.encode_part

    def encode_late(shown, part, get):
        made.encoded.append(part)
        assert made.may_answer.wait(DEADLINE)
        return encode(shown, part, get)

    monkeypatch.setattr(queryables, "encode_part", encode_late)
    with ExitStack() as stack:
        made = Coordinator(f"tcp/127.0.0.1:{free_port()}", stack)
        yield made


def test_a_slow_answer_delays_nothing_else_on_the_link(coordinator):
    status, best = SimpleQueue(), SimpleQueue()
    coordinator.ask(status)
    until(lambda: coordinator.encoded == [""])
    coordinator.ask(best, "best")
    coordinator.asking.put(OTHER, b"a heartbeat")
    assert coordinator.heard.get(timeout=DEADLINE).payload.to_bytes() == b"a heartbeat"
    until(lambda: coordinator.encoded == ["", "best"], "parts do not wait for each other")
    assert status.empty()
    coordinator.may_answer.set()
    assert status.get(timeout=DEADLINE).ok
    assert best.get(timeout=DEADLINE).ok


def test_few_queries_wait_and_those_alike_are_answered_at_one_cost(coordinator):
    replies, many = SimpleQueue(), 3 * MOST_WAITING
    coordinator.ask(replies)
    until(lambda: coordinator.encoded == [""])
    for number in range(many):
        coordinator.ask(replies, parameters=f"x={number}")  # the status has no parameters
    coordinator.asking.put(OTHER, b"")
    coordinator.heard.get(timeout=DEADLINE)  # after all queries
    coordinator.may_answer.set()
    until(lambda: replies.qsize() == MOST_WAITING + 1)
    assert coordinator.encoded == [""]
    coordinator.shown = snapshot(generations=9)
    coordinator.ask(replies)
    coordinator.ask(replies, "best", "offset=0")
    coordinator.ask(replies, "best", "offset=1")
    until(lambda: replies.qsize() == MOST_WAITING + 4)
    assert sorted(coordinator.encoded) == ["", "", "best", "best"]
