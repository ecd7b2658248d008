import numpy as np
import pytest

from dreamfleet.worker.training.data.drive_steps import (
    FIRST_START,
    LOSS_STEPS,
    DriveStep,
    find_road_losses,
    on_road_mask,
    sample_steps,
)


def drive(steps, *paid):
    """Rewards of so many steps, positive at these."""
    rewards = np.full(steps, -0.1, np.float32)
    rewards[list(paid)] = 3.4
    return rewards


def drawn(drives, count, seed=0):
    return sample_steps(drives, count, np.random.default_rng(seed))


@pytest.mark.parametrize(
    ("rewards", "lost"),
    [
        (drive(100, *range(50)), [50]),
        (drive(100, *range(50), 90), [50]),
        (drive(100, *range(50), 89), []),
        (drive(100, *range(60)), [60]),
        (drive(100, *range(61)), []),  # too short to know
        (drive(200, *range(0, 200, 40)), []),
        (drive(200, *range(0, 60, 20), 150), [41, 151]),
        (drive(100), []),  # it never found the road
        (drive(10, 1), []),
    ],
)
def test_a_loss_is_found_by_rewards_alone(rewards, lost):
    assert find_road_losses(rewards) == lost
    for step in lost:
        assert rewards[step - 1] > 0
        assert len(rewards[step : step + LOSS_STEPS]) == LOSS_STEPS
        assert not (rewards[step : step + LOSS_STEPS] > 0).any()


def test_half_of_them_lie_shortly_before_a_loss_and_the_rest_anywhere():
    drives = [drive(200, *range(80 + number)) for number in range(40)]
    found = drawn(drives, 60)
    assert (len(found.before_losses), len(found.anywhere), len(set(found.all))) == (30, 30, 60)
    assert len({moment.drive for moment in found.before_losses}) == 30, "one a loss"
    before = [80 + number - step for number, step in found.before_losses]
    assert 5 <= min(before) < 20
    assert 45 < max(before) <= 60
    steps = [moment.step for moment in found.anywhere]
    assert FIRST_START <= min(steps) < 60
    assert 150 < max(steps) < 200


def test_where_too_few_roads_are_lost_the_rest_is_drawn_anywhere():
    found = drawn([drive(200, *range(200)), drive(200, *range(80)), drive(200, *range(24))], 60)
    assert [moment.drive for moment in found.before_losses] == [1]
    assert len(found.anywhere) == 59
    assert {moment.drive for moment in found.anywhere} == {0, 1, 2}


def test_no_moment_is_drawn_twice_or_of_the_first_steps_and_all_may_be():
    drives = [drive(FIRST_START + 3, 0), drive(FIRST_START), drive(5), drive(FIRST_START + 42, *range(FIRST_START + 2))]
    every = [DriveStep(0, FIRST_START + step) for step in range(3)] + [
        DriveStep(3, FIRST_START + step) for step in range(42)
    ]
    assert list(drawn(drives, 1000).all) == every


def test_where_most_drives_are_short_dreams_begin_behind_half_the_usual_length():
    found = drawn([drive(FIRST_START), drive(8), drive(6)], 1000)
    assert list(found.all) == [DriveStep(0, step) for step in range(4, FIRST_START)] + [
        *(DriveStep(1, step) for step in range(4, 8)), *(DriveStep(2, step) for step in (4, 5)),
    ]  # fmt: skip
    assert drawn([drive(1)], 1000).all == (DriveStep(0, 0),)


def test_they_follow_from_the_seed():
    drives = [drive(200, *range(80)), drive(90)]
    assert drawn(drives, 20, seed=1) == drawn(drives, 20, seed=1) != drawn(drives, 20, seed=2)


def test_steps_behind_a_loss_of_the_road_are_left_out():
    reward = np.full(100, -0.1, np.float32)
    reward[[3, 30, 90]] = 3
    assert np.flatnonzero(~on_road_mask(reward)).tolist() == [*range(31, 51), *range(91, 100)]
    assert not on_road_mask(np.full(5, -0.1, np.float32)).any()
