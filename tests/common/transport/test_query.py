"""Questions over a real router, and what comes back."""

import pytest
import zenoh

from dreamfleet.common.transport.query import query_all
from dreamfleet.common.transport.session import Network, open_session
from tests.support.processes import free_port

HELD = []


@pytest.fixture(scope="module")
def session():
    """A client, beside a router that answers `a/*` with the question's own key and payload, and never answers `b`."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"

    def answer(query):
        with query:
            if str(query.key_expr) == "a/wrong":
                query.reply_err(b"no")
                return
            said = b"" if query.payload is None else query.payload.to_bytes()
            query.reply(query.key_expr, str(query.key_expr).encode() + b" " + said)

    with open_session(Network(listen=(endpoint,))) as router, open_session(Network(connect=(endpoint,))) as client:
        declared = [
            router.declare_queryable("a/*", zenoh.handlers.Callback(answer, indirect=False)),
            router.declare_queryable("b", zenoh.handlers.Callback(HELD.append, indirect=False)),
        ]
        yield client
        for each in HELD:
            each.drop()
        del declared


def test_every_reply_to_every_question_comes_back(session):
    assert sorted(query_all(session, ["a/1", "a/2"], 10.0, b"{}")) == [b"a/1 {}", b"a/2 {}"]
    assert query_all(session, ["a/3"], 10.0) == [b"a/3 "]


def test_an_error_and_a_key_that_nobody_serves_are_no_replies(session):
    assert query_all(session, ["a/wrong", "nobody"], 10.0) == []
    assert query_all(session, [], 10.0) == []


def test_silence_ends_with_the_timeout_and_what_came_is_kept(session):
    assert query_all(session, ["a/1", "b"], 0.3) == [b"a/1 "]


def test_told_to_stop_it_does_not_wait_for_the_timeout(session):
    looks = iter([False, False, True])
    assert query_all(session, ["b"], 3600.0, stopped=lambda: next(looks)) == []
