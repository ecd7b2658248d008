"""What anybody may send a client: it is passed over, or a readable error."""

import json
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest

from dreamfleet.common.addons.batches.batch_client import BatchClient
from dreamfleet.common.addons.frames.live import LiveView
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import AccessError
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import encode_json
from dreamfleet.common.schema.validation import MalformedError
from dreamfleet.common.security.credentials import Credentials
from dreamfleet.common.transport.session import Network, open_session
from tests.support.processes import free_port, until
from tests.support.samples import STATUS

RUN = STATUS.run
LEFT = replace(STATUS, state="left")
NO_FINAL_STATUSES = (
    b"", b"{}", b'{"state": ["ended"]}', encode_json(STATUS), encode_json(LEFT)[:-9],
    encode_json(replace(LEFT, run_uid="another")),
)  # fmt: skip


@contextmanager
def serving(answers):
    """A router that gives these answers to queries for parts of the status, and a client of it."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_session(Network(listen=(endpoint,))) as served:
        for part in answers:
            served.declare_queryable(
                keys.status(RUN, part), lambda query, part=part: query.reply(query.key_expr, answers[part])
            )
        with Client(endpoint) as client:
            yield served, client


def test_a_client_whose_join_file_has_ended_names_that_and_no_dead_run():
    with serving({"": encode_json(STATUS)}) as (_, client):
        assert client.status(RUN) == STATUS
        client._credentials = Credentials("viewer", 1, "anna", datetime.now(UTC) - timedelta(days=1), "")
        for ask in (client.statuses, lambda: client.status(RUN), lambda: BatchClient(client).list_batches(RUN)):
            with pytest.raises(AccessError):
                ask()


def test_a_watch_ends_with_the_runs_own_last_status_alone():
    with serving({"": encode_json(STATUS)}) as (served, client):
        watch = client.watch(RUN, pause=60.0)
        assert next(watch) == STATUS
        for said in (*NO_FINAL_STATUSES, encode_json(LEFT)):
            served.put(keys.event_status(RUN), said)
        assert list(watch) == [LEFT]


def test_a_view_ends_with_the_runs_own_last_status_alone():
    answers = {"": encode_json(STATUS), "workers": json.dumps({"workers": [], "total": 0}).encode()}
    with serving(answers) as (served, client), LiveView(client, RUN) as view:
        client.status(RUN)  # answered, so the view's subscription has arrived too
        for said in (*NO_FINAL_STATUSES, encode_json(LEFT)):
            served.put(keys.event_status(RUN), said)
        until(lambda: view.next(timeout=0.01) is not None or view.is_over)
        assert view.status == LEFT


def test_an_odd_page_of_a_list_is_a_readable_error():
    parts = {"workers": Client.workers, "history": Client.history, "evaluations": Client.evaluations,
             "story": Client.events}  # fmt: skip
    odd_rows, odd_totals = (None, 1, "xy", {}, [1], [{}]), (None, "1", 1.0, True, [])
    answers = dict.fromkeys(parts, b"")
    with serving(answers) as (_, client):
        for part, fetch in parts.items():
            pages = [{part: odd, "total": 1} for odd in odd_rows] + [{part: [], "total": odd} for odd in odd_totals]
            for page in ({}, {"total": 1}, *pages):
                answers[part] = json.dumps({"run": RUN, **page}).encode()
                with pytest.raises(MalformedError):
                    fetch(client, RUN)
