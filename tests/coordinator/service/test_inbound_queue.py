import queue

from dreamfleet.common.protocol.messages import MAX_MESSAGE
from dreamfleet.coordinator.service.inbound_queue import HELLO_LIMIT, QUEUE_LIMITS, InboundQueue, QueueLimit


def taken(arrivals):
    events = []
    while True:
        try:
            events.append(arrivals.get(0))
        except queue.Empty:
            return events


def test_a_kind_is_bounded_in_count_and_leaves_room_for_the_others():
    arrivals = InboundQueue({"result": QueueLimit(2, 1000), "beat": QueueLimit(2, 1000)})
    assert [arrivals.put("result", n, 1, 0.0) for n in range(3)] == [True, True, False]
    assert arrivals.put("beat", 3, 1, 0.0)
    assert taken(arrivals) == [("result", 0), ("result", 1), ("beat", 3)]
    assert arrivals.dropped == {"too many at once": 1}
    assert arrivals.put("result", 4, 1, 0.0), "what was taken out makes room"


def test_a_kind_is_bounded_in_bytes_and_so_is_each_message():
    arrivals = InboundQueue({"result": QueueLimit(100, 100_000)})
    assert not arrivals.put("result", 0, MAX_MESSAGE + 1, 0.0)
    assert max(each.size for each in QUEUE_LIMITS.values()) <= 32 << 20, "a small part of a host's memory"
    assert [arrivals.put("result", n, 40_000, 0.0) for n in range(3)] == [True, True, False]
    assert arrivals.dropped == {"oversize": 1, "too many at once": 1}


def test_hellos_may_arrive_in_a_burst_and_then_at_a_bounded_rate():
    arrivals = InboundQueue({"hello": QueueLimit(10, 1000, 5.0)})
    assert sum(arrivals.put("hello", n, 1, 0.0) for n in range(20)) == 10
    assert len(taken(arrivals)) == 10
    assert sum(arrivals.put("hello", n, 1, 0.0) for n in range(20)) == 0
    assert sum(arrivals.put("hello", n, 1, 1.0) for n in range(20)) == 5
    assert arrivals.dropped["too many in a second"] == 35


def test_a_hello_waits_for_other_events_but_not_forever():
    arrivals = InboundQueue({"hello": QueueLimit(10, 1000), "beat": QueueLimit(100, 1000)})
    arrivals.put("hello", 0, 1, 0.0)
    for number in range(2 * HELLO_LIMIT):
        arrivals.put("beat", number, 1, 0.0)
    kinds = [kind for kind, _ in taken(arrivals)]
    assert kinds == ["beat"] * HELLO_LIMIT + ["hello"] + ["beat"] * HELLO_LIMIT


def test_a_wake_is_never_dropped():
    arrivals = InboundQueue({})
    arrivals.wake()
    assert taken(arrivals) == [("wake", None)]
