"""What strangers put on the wire changes nothing, and is counted."""

import pytest

from common import keys
from common.codec import encode
from common.messages import MAX_MESSAGE
from common.session import Network, open_session
from tests.support import tasks
from tests.support.samples import MSGPACK

pytestmark = pytest.mark.timeout(120)


def test_a_coordinator_drops_and_counts_what_is_malformed_or_foreign(processes, random_bundle):
    coordinator = processes.coordinator(
        "--bundle", random_bundle.path, "--task", tasks.SLOW_TOY, "--population", 4, "--evaluate-every", 0,
        "--generations", 5,
    )  # fmt: skip
    with open_session(Network(connect=(processes.endpoint,))) as session:
        for kind in ("result", "beat"):
            key = getattr(keys, kind)("test", "stranger/0badc0de")
            for payload in (b"", b"\xc1\xff", bytes(MAX_MESSAGE + 1), encode(MSGPACK[kind]), encode(MSGPACK["view"])):
                session.put(key, payload)
        replies = list(session.get(keys.hello("test"), payload=b"let me in", timeout=5))
        assert b'"accepted": false' in replies[0].ok.payload.to_bytes()
        assert not list(session.get(keys.bundle("test", "ab" * 32), timeout=1))
    while sum((dropped := processes.status()["dropped"]).values()) < 11:
        pass
    assert dropped == {"not msgpack": 4, "oversize": 2, "foreign run": 2, "wrong fields": 2, "not JSON": 1}
    processes.worker("--task", tasks.SLOW_TOY)
    assert coordinator.finish()[0] == 0


def test_a_worker_drops_what_is_malformed_or_of_another_coordinator(processes, random_bundle):
    coordinator = processes.coordinator(
        "--bundle", random_bundle.path, "--task", tasks.SLOW_TOY, "--population", 4, "--evaluate-every", 0,
        "--generations", 5,
    )  # fmt: skip
    worker = processes.worker("--task", tasks.SLOW_TOY, "--exit-when-done")
    worker.wait_for("joined")
    identity = processes.status()["worker_list"][0]["worker"]
    with open_session(Network(connect=(processes.endpoint,))) as session:
        for payload in (b"", b"\xc1\xff", bytes(MAX_MESSAGE + 1), encode(MSGPACK["job"]), encode(MSGPACK["beat"])):
            session.put(keys.job("test", identity), payload)
    assert coordinator.finish()[0] == 0
    assert worker.finish()[0] == 0
