"""Who scores a round's run, and which of its means drive for the next."""

import pytest

from dreamfleet.common.stored import StoredEvaluation
from dreamfleet.coordinator.iteration.evolving import Crew
from dreamfleet.coordinator.iteration.phases import best_others


def test_without_an_address_this_host_scores_alone_with_a_slot_a_core():
    crew = Crew.of((), None, (), ())
    assert crew.listen[0].startswith("tcp/127.0.0.1:")
    assert crew.slots > 0
    assert Crew.of((), 3, (), ()).slots == 3


@pytest.mark.parametrize(
    ("listen", "near"),
    [("tcp/0.0.0.0:7447", "tcp/127.0.0.1:7447"), ("tcp/[::]:7447", "tcp/127.0.0.1:7447"), ("tcp/host:1", "tcp/host:1")],
)
def test_where_workers_come_from_anywhere_this_host_scores_only_if_asked(listen, near):
    assert Crew.of((listen,), None, (), ()).slots == 0
    crew = Crew.of((listen,), 2, (), ())
    assert (crew.listen, crew.near, crew.slots) == ((listen,), near, 2)


def test_the_best_evaluated_means_drive_beside_the_reported_one():
    seen = [
        StoredEvaluation(generation, 4, mean, 1.0) for generation, mean in ((4, 1.0), (9, 5.0), (14, 3.0), (19, 5.0))
    ]
    assert best_others(seen, 19, 2) == [9, 14]
    assert best_others(seen, None, 9) == [9, 19, 14, 4]
    assert best_others(seen, 4, 0) == []
