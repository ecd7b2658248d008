"""What anybody may send a client, statuses above all: it is passed over, or a readable error. Tests status.py."""

import json
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from dreamfleet.common.addons.batches.batch_client import BatchClient
from dreamfleet.common.addons.frames.live import LiveView
from dreamfleet.common.client.client import Client
from dreamfleet.common.client.status import Candidate, read_document, read_status
from dreamfleet.common.errors import AccessError
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import encode_json
from dreamfleet.common.protocol.host_classes import HostClasses, HostClassShare
from dreamfleet.common.schema.validation import MalformedError
from dreamfleet.common.security.credentials import Credentials
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.coordinator.addons.status.verb import print_runs
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


GOLDEN = Path(__file__).parents[1] / "golden" / "status.v2.json"


def test_the_golden_status_is_read_and_written():
    assert read_status(read_document(GOLDEN.read_bytes())) == STATUS
    assert json.loads(encode_json(STATUS)) == json.loads(GOLDEN.read_bytes())


def test_fields_of_later_versions_are_ignored_at_any_depth():
    document = json.loads(GOLDEN.read_bytes())
    later = {"later": {"anything": [1]}}
    document |= later
    for part in (document["settings"], document["settings"]["task"], document["worker_list"][0], document["waste"],
                 document["population"], document["recent"][0], document["best"]):  # fmt: skip
        part.update(later)
    assert read_status(document) == STATUS


def test_the_error_for_a_missing_field_or_a_value_out_of_range_names_the_version_to_install():
    odd = {("evaluation", "episodes"): 0, ("best", "episodes"): -1, ("population", "done"): [1], ("waste",): None}
    for (part, *field), value in odd.items():
        document = json.loads(GOLDEN.read_bytes())
        if field:
            document[part][field[0]] = value
        else:
            del document[part]
        with pytest.raises(MalformedError, match=r"night .*0\.1\.0"):
            read_status(document)
    with pytest.raises(MalformedError, match=r"1.* 2"):  # the first schema
        read_status({"schema": 1, "run": "night", "package": "0.0.9", "state": "running"})


def test_a_population_has_columns_and_rows_and_host_classes_need_no_names():
    population = replace(STATUS.population, offset=4)
    assert population.candidates[1] == Candidate(7, 5, 1, 2, -3.25)
    assert population.candidates[2].fitness is None
    assert HostClasses(total=1).description
    assert "2" in HostClasses(2, (HostClassShare("a" * 16, 0, ()),), 0).description


MANY_DIGITS = b'{"limits": {"generations": 1%s}}' % (b"0" * 400)


@pytest.mark.parametrize("payload", [b"", b"[]", b"\xff", b"{" * 20000, b"1", MANY_DIGITS])
def test_an_invalid_document_is_a_readable_error(payload):
    with pytest.raises(MalformedError):
        read_document(payload)
    assert read_document(b'{"limits": {"generations": 18446744073709551615}}')


if __name__ == "__main__" and not GOLDEN.exists():
    GOLDEN.write_bytes(encode_json(STATUS))


def test_one_invalid_reply_among_several_runs_is_only_noted(capsys):
    first, other, liar = (json.loads(encode_json(replace(STATUS, run=run))) for run in ("b", "a", "liar"))
    print_runs([first, liar | {"evaluations": -1}, other])
    output = capsys.readouterr()
    assert [line.split()[0] for line in output.out.splitlines() if line.split()[0] in {"a", "b", "liar"}] == ["a", "b"]
    assert "liar" in output.err
    assert "2 live runs" in output.err
