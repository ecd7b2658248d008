"""Workers of other protocol versions are refused, with a remedy."""

from dataclasses import replace

from dreamfleet.common.client.client import Client
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import decode_json, encode_json
from dreamfleet.common.protocol.messages import HelloReply
from dreamfleet.common.transport.session import Network, open_session
from tests.support import tasks
from tests.support.processes import DEADLINE, until
from tests.support.samples import JSON

OTHERS = (1, 1), (3, 4), (2**60, 2**62)
OURS = (1, 2), (2, 3), (2, 2)


def test_a_worker_joins_if_it_speaks_this_protocol_and_else_gets_a_remedy(processes):
    processes.coordinator("--task", tasks.TOY, "--population", 4, "--episodes", 1, "--generations", 3)
    worker = replace(JSON["hello-request"], worker="old/0a1b2c3d", tasks=(tasks.TOY,), fingerprint=fingerprint())
    with open_session(Network(connect=(processes.endpoint,))) as session, Client((processes.endpoint,)) as client:

        def hello(first, last):
            request = encode_json(replace(worker, protocol_min=first, protocol_max=last))
            (reply,) = session.get(keys.hello("test"), payload=request, timeout=DEADLINE)
            return decode_json(HelloReply, reply.ok.payload.to_bytes())

        for spoken in OTHERS:
            reply = hello(*spoken)
            assert not reply.accepted
            assert all(str(each) in reply.why for each in (*spoken, keys.PROTOCOL_VERSION))
            assert reply.remedy
            until(lambda why=reply.why: client.status().refused == {"old": why})
        assert all(hello(*spoken).accepted for spoken in OURS)
        until(lambda: not client.status().refused)
