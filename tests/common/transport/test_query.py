import pytest
import zenoh

from dreamfleet.common.transport.query import query_all, query_every_responder
from dreamfleet.common.transport.session import Network, open_session
from tests.support.processes import free_port

HELD = []


@pytest.fixture(scope="module")
def session():
    """A client of a router that replies to `a/*` with the query's key and payload, and never to `b`."""
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


def test_every_reply_to_every_query_is_returned_and_errors_and_unserved_keys_are_none(session):
    assert sorted(query_all(session, ["a/1", "a/2"], 10.0)) == [b"a/1 ", b"a/2 "]
    assert [found for _, found in query_every_responder(session, ["a/3"], 10.0, b"{}")] == [b"a/3 {}"]
    assert query_all(session, ["a/wrong", "nobody"], 10.0) == query_all(session, [], 10.0) == []


def test_the_timeout_ends_a_query_and_keeps_earlier_replies(session):
    assert query_all(session, ["a/1", "b"], 0.3) == [b"a/1 "]


def test_stopping_does_not_wait_for_the_timeout(session):
    looks = iter([False, False, True])
    assert list(query_every_responder(session, ["b"], 3600.0, stopped=lambda: next(looks))) == []
