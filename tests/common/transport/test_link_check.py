"""When a session that is not let in must be opened anew, by a clock of the test's."""

import logging
from types import SimpleNamespace

import pytest

from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.transport import link_check
from dreamfleet.common.transport.link_check import CHECK_INTERVAL, LINK_TIMEOUT, LinkCheck
from dreamfleet.common.transport.network import Network
from tests.support.processes import until

FIRST, SECOND = "tcp/one.example:7447", "tcp/two.example:7447"


class Links:
    """A client's session and what answers at its addresses."""

    def __init__(self):
        self.routers, self.answering, self.tried = [], {}, 0
        self.info = SimpleNamespace(routers_zid=lambda: self.routers, zid=lambda: "own")
        self.check = LinkCheck(Network(connect=(FIRST, SECOND)), logging.getLogger("dreamfleet.router"))
        self.now = self.check._linked_at

    def open(self, network):
        (address,) = network.connect
        self.tried += 1
        if address not in self.answering:
            raise ConnectionFailedError("nobody answers")
        there = [self.answering[address]]
        return SimpleNamespace(info=SimpleNamespace(routers_zid=lambda: there), close=lambda: None)

    def look(self, seconds=CHECK_INTERVAL):
        """What is found after so many seconds; a look that begins is over by the next."""
        self.now += seconds
        found = self.check.find_apart(self, self.now)
        if self.check._probe is not None:
            until(self.check._probe.done)
        return found


@pytest.fixture
def links(monkeypatch):
    made = Links()
    monkeypatch.setattr(link_check, "open_session", made.open)
    monkeypatch.setattr(link_check, "RELINK_TIME", 0.0)
    return made


def events(caplog):
    return [each.facts["event"] for each in caplog.records]


def test_a_session_that_stays_out_where_another_gets_in_must_be_opened_anew(links, caplog):
    links.answering = {SECOND: "a"}
    assert links.look(LINK_TIMEOUT - 1) == []
    assert links.tried == 0
    assert links.look() == []
    assert links.look() == [SECOND]
    assert sorted(events(caplog)) == ["apart", "unlinked"]
    assert links.look(LINK_TIMEOUT) == []
    assert links.tried == 2, "each time the pause is twice as long"
    assert links.look(LINK_TIMEOUT) == []
    assert links.look() == [SECOND]
    assert events(caplog).count("unlinked") == 1


def test_a_link_that_returns_meanwhile_changes_nothing(links, caplog):
    links.answering = {FIRST: "a"}
    links.look(LINK_TIMEOUT)
    links.routers = ["a"]
    assert links.look() == []
    links.routers = []
    assert links.look(LINK_TIMEOUT - 1) == []
    assert links.tried == 2
    assert events(caplog) == []


def test_where_nobody_answers_the_session_stays(links, caplog):
    for _ in range(3):
        assert links.look(LINK_TIMEOUT) == []
        assert links.look() == []
    assert links.tried == 6
    assert events(caplog) == ["unlinked", "unlinked"]


def test_a_router_whose_own_address_is_among_them_is_not_opened_anew(links, caplog):
    links.answering = {FIRST: "own", SECOND: "a"}
    links.routers = ["a"]
    links.check._network = Network(listen=(FIRST,), connect=(FIRST, SECOND))
    links.info.transports = links.info.links = list
    for _ in range(3):
        assert links.look(LINK_TIMEOUT) == []
        assert links.look() == []
    assert links.tried == 6
    assert events(caplog) == []
