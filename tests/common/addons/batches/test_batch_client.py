"""How long a client waits for a batch to be stored, over real Zenoh."""

from threading import Thread
from time import sleep

import numpy as np
import pytest
import zenoh

from dreamfleet.common.addons.batches import batch_client
from dreamfleet.common.addons.batches.batch_client import BatchClient
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.batches import BatchReply, pack_batch
from dreamfleet.common.protocol.codec import encode_json
from dreamfleet.common.transport.network import Network
from dreamfleet.common.transport.session import open_session
from tests.support.processes import DEADLINE, free_port

LATE = 0.5  # seconds
STORED = BatchReply(v=keys.PROTOCOL_VERSION, run="night", id="a", state="waiting", population=2)


def reply_late(query):
    sleep(LATE)
    with query:
        query.reply(query.key_expr, encode_json(STORED))


def test_a_large_batch_has_longer_to_be_stored(monkeypatch):
    monkeypatch.setattr(batch_client, "QUERY_TIMEOUT", LATE / 10)
    monkeypatch.setattr(batch_client, "GRACE", 0.0)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    header, body = pack_batch("a", np.zeros((2, 3)), [1], 0)
    with (
        open_session(Network(listen=(endpoint,))) as session,
        session.declare_queryable(
            keys.batch("night", "*"),
            zenoh.handlers.Callback(lambda query: Thread(target=reply_late, args=(query,)).start(), indirect=False),
        ),
        Client(Network(connect=(endpoint,))) as client,
    ):
        batches = BatchClient(client)
        with pytest.raises(ConnectionFailedError):
            batches.submit("night", header, body)
        monkeypatch.setattr(batch_client, "LEAST_RATE", header.total / DEADLINE)
        assert batches.submit("night", header, body) == STORED
