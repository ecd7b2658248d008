"""A worker that fetches its run's world model: damage, and what an earlier download left."""

import pytest

from dreamfleet.common.errors import BundleError
from dreamfleet.common.messages import MAX_PART
from dreamfleet.common.store import BundleStore, default_cache
from tests.support.hand import DEADLINE
from tests.support.stage import wait_for

pytestmark = pytest.mark.timeout(60)


def test_a_damaged_part_costs_one_more_download(stage, said):
    hand = stage.hand()
    spoilt = iter([bytes(MAX_PART)[:-1] + b"!"])
    hand.damage = lambda offset, data: next(spoilt, data) if offset == 2 * MAX_PART else data
    stage.worker()
    assert "arrived damaged" in wait_for(said, "attempt 1 of 3")
    hand.ready()
    asked = [hand.offsets.get_nowait() for _ in range(hand.offsets.qsize())]
    assert asked.count(2 * MAX_PART) == 2


def test_a_bundle_that_is_always_damaged_is_an_error_that_says_so(stage):
    hand = stage.hand()
    hand.damage = lambda offset, data: data[::-1]
    _, served = stage.worker()
    error = served.exception(DEADLINE)
    assert isinstance(error, BundleError)
    assert "damaged 3 times" in str(error)


@pytest.mark.parametrize(("beginning", "first"), [(3 * MAX_PART + 17, 3 * MAX_PART + 17), (9 * MAX_PART, 9 * MAX_PART)])
def test_an_interrupted_download_goes_on_and_a_longer_one_begins_again(stage, beginning, first):
    hand = stage.hand()
    with BundleStore(default_cache()).downloading(stage.bundle.sha256) as path:
        path.write_bytes((stage.bundle.path.read_bytes() + bytes(9 * MAX_PART))[:beginning])
    stage.worker()
    hand.ready()
    asked = [hand.offsets.get_nowait() for _ in range(hand.offsets.qsize())]
    assert asked[0] == first
    assert (0 in asked) == (beginning > 7 * MAX_PART)
