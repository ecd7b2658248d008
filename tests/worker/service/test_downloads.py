"""A worker fetches its run's world model although parts of it arrive damaged, or from a stranger."""

import pytest

from dreamfleet.common.errors import DownloadError
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import encode
from dreamfleet.common.protocol.messages import MAX_PART, BundlePart
from dreamfleet.common.transport.session import Network, open_session
from tests.support.hand import DEADLINE
from tests.support.stage import wait_for


def test_a_damaged_part_costs_one_more_download(stage):
    hand = stage.hand()
    spoilt = iter([bytes(MAX_PART)[:-1] + b"!"])
    hand.damage = lambda offset, data: next(spoilt, data) if offset == 2 * MAX_PART else data
    stage.worker()
    hand.ready()
    asked = [hand.offsets.get_nowait() for _ in range(hand.offsets.qsize())]
    assert asked.count(2 * MAX_PART) == 2


def test_a_bundle_that_is_always_damaged_is_an_error(stage):
    hand = stage.hand()
    hand.damage = lambda offset, data: data[::-1]
    _, served = stage.worker(exit_when_done=True)
    assert isinstance(served.exception(DEADLINE), DownloadError)


@pytest.mark.slow
def test_it_asks_again_for_a_bundle_that_arrived_damaged(stage, said):
    hand = stage.hand()
    hand.damage = lambda offset, data: data[::-1]
    stage.worker()
    for _ in range(4):  # three times, and that it asks again
        wait_for(said, hand.spec.bundle[:12])
    hand.damage = lambda offset, data: data
    assert hand.ready().slots == 1


def test_wrong_parts_of_a_stranger_do_not_prevent_the_download(stage, said):
    """A stranger answers first for every part, with wrong bytes."""
    hand = stage.hand()
    head = {"run_uid": hand.run_uid, "incarnation": 1, "sha256": bytes.fromhex(stage.bundle.sha256)}

    def lie(query):
        offset = int(query.parameters.get("offset"))
        total = stage.bundle.path.stat().st_size
        with query:
            data = bytes(min(MAX_PART, total - offset))
            query.reply(query.key_expr, encode(BundlePart(**head, offset=offset, total=total, data=data)))

    with open_session(Network(connect=(hand.endpoint,))) as session:
        session.declare_queryable(keys.bundle("test", stage.bundle.sha256), lie, complete=True)
        stage.worker()
        assert hand.ready().slots == 1
