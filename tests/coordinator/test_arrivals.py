import queue

import pytest

from dreamfleet.common.messages import MAX_MESSAGE
from dreamfleet.coordinator.arrivals import BOUNDS, Arrivals, Bound


def taken(arrivals):
    events = []
    while True:
        try:
            events.append(arrivals.get(0))
        except queue.Empty:
            return events


def test_a_kind_is_bounded_in_count_and_leaves_room_for_the_others():
    arrivals = Arrivals({"result": Bound(2, 1000), "beat": Bound(2, 1000)})
    assert [arrivals.put("result", n, 1, 0.0) for n in range(3)] == [True, True, False]
    assert arrivals.put("beat", 3, 1, 0.0)
    assert taken(arrivals) == [("result", 0), ("result", 1), ("beat", 3)]
    assert arrivals.dropped == {"too many at once": 1}
    assert arrivals.put("result", 4, 1, 0.0), "what was taken out makes room"


def test_a_kind_is_bounded_in_bytes_and_so_is_each_message():
    arrivals = Arrivals({"result": Bound(100, 100_000)})
    assert not arrivals.put("result", 0, MAX_MESSAGE + 1, 0.0)
    assert [arrivals.put("result", n, 40_000, 0.0) for n in range(3)] == [True, True, False]
    assert arrivals.dropped == {"oversize": 1, "too many at once": 1}


def test_a_burst_of_hellos_is_taken_and_then_so_many_a_second():
    arrivals = Arrivals({"hello": Bound(10, 1000, 5.0)})
    assert sum(arrivals.put("hello", n, 1, 0.0) for n in range(20)) == 10
    assert len(taken(arrivals)) == 10
    assert sum(arrivals.put("hello", n, 1, 0.0) for n in range(20)) == 0
    assert sum(arrivals.put("hello", n, 1, 1.0) for n in range(20)) == 5
    assert arrivals.dropped["too many in a second"] == 35


def test_a_wake_is_never_dropped():
    arrivals = Arrivals({})
    arrivals.wake()
    assert taken(arrivals) == [("wake", None)]


@pytest.mark.parametrize("kind", BOUNDS)
def test_what_may_wait_is_a_small_part_of_a_hosts_memory(kind):
    assert BOUNDS[kind].size <= 32 << 20
