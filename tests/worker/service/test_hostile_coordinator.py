"""Neither a coordinator's message nor a task ends a worker."""

import json

import pytest

from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import encode
from dreamfleet.common.protocol.failures import MAX_CAUSE, Failure
from dreamfleet.common.protocol.messages import Result, ResultBatch
from dreamfleet.common.schema.validation import MAX_TEXT
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.worker.service.admission import find_run_with_fewest_slots
from dreamfleet.worker.service.outbox import Outbox
from dreamfleet.worker.service.run_session import RunSession
from tests.support.processes import free_port
from tests.support.samples import HEAD
from tests.support.stage import wait_for


def test_a_batch_that_raises_costs_only_itself(stage, cached, said, monkeypatch):
    hand, *_ = stage.served()
    take = RunSession._handle_batch
    monkeypatch.setattr(RunSession, "_handle_batch", lambda *_: 1 / 0)
    hand.send(1, hand.job())
    wait_for(said, "ZeroDivisionError")
    monkeypatch.setattr(RunSession, "_handle_batch", take)
    hand.send(1, hand.job())
    assert hand.result(hand.job()).fitness is not None


def test_results_with_long_errors_are_split_into_messages():
    outbox = Outbox(1.0)
    for number in range(200):
        outbox.add(Result(number.to_bytes(32), None, 0, 0.0, Failure("ü" * MAX_TEXT, "ü" * MAX_CAUSE, "usage"), None))
    messages = outbox.due(0.0)
    for results in messages:
        encode(ResultBatch(**HEAD, fingerprint="f" * MAX_TEXT, results=results))
    assert sum(map(len, messages)) == 200


@pytest.mark.parametrize(
    "odd",
    [
        {"slots": "1e999"}, {"slots": "1" + 400 * "0"}, {"slots": "NaN"}, {"slots": "[]"}, {"share": "NaN"},
        *({"run": json.dumps(name)} for name in ("", "a#b", "*", "\ud800", ["odd"])),
    ],
    ids=lambda odd: f"{odd}"[:20],
)  # fmt: skip
def test_an_odd_status_of_another_run_keeps_no_worker_from_a_run(odd):
    """Tests admission.py. A name that no key may contain raised where the run was asked."""
    good = {"state": '"running"', "run": '"good"', "slots": "3", "share": "1.0"}
    answers = {"good": good, "odd": {**good, "run": '"odd"', "slots": "400", **odd}}
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_session(Network(listen=(endpoint,))) as served:
        for name, fields in answers.items():
            said = "{" + ", ".join(f'"{field}": {value}' for field, value in fields.items()) + "}"
            served.declare_queryable(keys.status(name), lambda query, said=said: query.reply(query.key_expr, said))
        with open_session(Network(connect=(endpoint,))) as session:
            while (found := find_run_with_fewest_slots(session)) is None:
                pass  # the declarations are on their way
            assert found == "good"
