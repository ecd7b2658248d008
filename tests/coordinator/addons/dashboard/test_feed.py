"""One poll a refresh for any number of viewers, and none without viewers."""

import asyncio
import threading
from functools import wraps

import pytest

from dreamfleet.coordinator.addons.dashboard.feed import Feed
from dreamfleet.coordinator.addons.dashboard.live_runs import DashboardSnapshot
from tests.support.processes import DEADLINE


class Looks:
    """Counts looks; each waits until it is let."""

    def __init__(self):
        self.count, self.rests = 0, 0
        self.are_single = False  # whether each has to be let anew
        self.gate = threading.Event()
        self.gate.set()

    def poll(self):
        assert self.gate.wait(DEADLINE)
        self.count += 1
        if self.count == 2:
            raise ValueError("a look that fails")
        if self.are_single:
            self.gate.clear()
        return DashboardSnapshot({}, None, str(self.count).encode())

    def suspend(self):
        self.rests += 1


def played(test):
    """A test that is a coroutine, in a loop of its own."""

    @wraps(test)
    def play(looks):
        asyncio.run(asyncio.wait_for(test(looks), 20))

    return play


@pytest.fixture
def looks():
    return Looks()


@pytest.mark.slow
@played
async def test_all_viewers_share_the_snapshots(looks):
    looks.are_single = True

    async def viewer(feed, snapshots, everybody):
        source, seen = feed.snapshots(), []
        for _ in range(snapshots):
            seen.append(await anext(source))
            if await everybody.wait() == 0:  # all have it: let the next look begin
                looks.gate.set()
        return seen

    feed, everybody = Feed(looks, refresh=0.01, linger=0.05), asyncio.Barrier(50)
    found = await asyncio.gather(*(viewer(feed, 3, everybody) for _ in range(50)))
    assert len({tuple(map(id, seen)) for seen in found}) == 1
    assert looks.count <= 6, "the second failed, and cost itself alone"


@played
async def test_a_slow_viewer_skips_snapshots_and_delays_nobody(looks):
    feed = Feed(looks, refresh=0.0, linger=0.05)
    slow, fast = feed.snapshots(), feed.snapshots()
    first = await anext(slow)
    for _ in range(20):
        last = await anext(fast)
    assert int((await anext(slow)).absent_event) >= int(last.absent_event) > int(first.absent_event) + 10


@played
async def test_polling_stops_without_viewers_and_a_later_viewer_gets_no_stale_snapshot(looks):
    feed = Feed(looks, refresh=0.01, linger=0.02)
    async for _ in feed.snapshots():
        break
    while looks.rests == 0:
        await asyncio.sleep(0)
    assert feed._polling is None
    before = looks.count
    looks.gate.clear()
    later = asyncio.ensure_future(anext(feed.snapshots()))
    while feed._polling is None:
        await asyncio.sleep(0)
    assert not later.done()
    looks.gate.set()
    assert int((await later).absent_event) > before


@played
async def test_closing_the_feed_ends_every_stream(looks):
    feed = Feed(looks, refresh=0.01, linger=10)
    viewer = feed.snapshots()
    await anext(viewer)
    feed.close()
    assert [picture async for picture in viewer] == []
