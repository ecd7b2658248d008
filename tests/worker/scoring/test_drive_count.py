"""How many drives a slot does side by side."""

import pytest

from dreamfleet.worker.scoring.drive_count import ENOUGH, MEASURE_AGAIN, DriveCount


def counting(most):
    count = DriveCount()
    count.most = most
    return count


def drive(count, costs, groups, waiting=99):
    """The numbers that are asked for by groups that take as long as `costs`: seconds a step by number of drives."""
    asked = []
    for _ in range(groups):
        asked.append(drives := count.choose(waiting))
        count.add(drives, 1000 * drives, 1000 * drives * costs[drives])
    return asked


@pytest.mark.parametrize(
    ("costs", "best"),
    [({4: 3, 2: 4, 1: 5}, 4), ({4: 5, 2: 3, 1: 4}, 2), ({4: 5, 2: 5, 1: 4}, 1), ({6: 1, 4: 2, 2: 3, 1: 4}, 6)],
)
def test_the_number_whose_steps_take_least_time_is_found_and_kept(costs, best):
    count = counting(max(costs))
    assert drive(count, costs, len(costs) * ENOUGH) == [number for number in costs for _ in range(ENOUGH)]
    assert drive(count, costs, MEASURE_AGAIN // 2) == [best] * (MEASURE_AGAIN // 2)


def test_a_host_that_changes_is_measured_again():
    count = counting(4)
    drive(count, {4: 3, 2: 4, 1: 5}, 3 * ENOUGH)
    asked = drive(count, {4: 6, 2: 4, 1: 5}, 8 * MEASURE_AGAIN)
    assert count.best == 2
    assert asked.count(1) < len(asked) / 20


def test_what_is_not_compared_changes_nothing():
    count = counting(2)
    for _ in range(ENOUGH):
        count.add(2, 0, 100.0)  # episodes that are over at once
        count.add(3, 1000, 0.1)  # more than a slot can do
    assert (count.choose(99), count.best) == (1, 2)


@pytest.mark.parametrize(
    ("waiting", "costs", "asked"),
    [(3, {3: 2, 2: 1, 1: 3}, [3, 2, 1, 2]), (2, {2: 2, 1: 1}, [2, 1, 1, 1]), (0, {1: 1}, [1] * 4)],
)
def test_with_few_jobs_a_slot_it_is_found_among_the_numbers_that_can_be(waiting, costs, asked):
    count = counting(4)
    assert drive(count, costs, 4 * ENOUGH, waiting)[::ENOUGH] == asked
    assert drive(count, {4: 1, **costs}, ENOUGH) == [4] * ENOUGH


def test_a_slot_that_drives_one_by_one_goes_on_so():
    count = DriveCount()
    assert drive(count, {1: 3}, 100) == [1] * 100
    assert count.best == count.most == 1
