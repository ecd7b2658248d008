"""What each worker did over the last minutes."""

import dataclasses

from dreamfleet.coordinator.addons.dashboard.lanes import IDLE, LENGTH, LOST, SILENT, STRETCH, Lanes
from tests.support.samples import STATUS


def worker(name, rate=0.0, state="present", slots=1):
    return dataclasses.replace(STATUS.worker_list[0], worker=name, steps_per_second=rate, state=state, slots=slots)


def test_a_lane_shows_a_slots_speed_relative_to_the_fastest():
    lanes = Lanes()
    fleet = [worker("a/1", 90.0), worker("b/1", 90.0, slots=2), worker("c/1"), worker("d/1", state="silent"),
             worker("e/1", 5.0, state="lost")]  # fmt: skip
    lanes.update(fleet, 100.0)
    render = lanes.render(fleet)
    assert {len(lane) for lane in render} == {LENGTH}
    assert [lane[-1] for lane in render] == ["9", "4", IDLE, SILENT, LOST]


def test_a_slice_keeps_the_last_state():
    lanes, present, lost = Lanes(), worker("a/1", 10.0), worker("a/1", state="lost")
    lanes.update([present], 100.0)
    lanes.update([lost], 100.0 + 0.9 * STRETCH)
    assert lanes.render([lost])[0].strip() == LOST


def test_slices_without_an_update_are_unknown_and_old_ones_are_dropped():
    lanes, present = Lanes(), worker("a/1", 10.0)
    lanes.update([present], 100.0)
    lanes.update([present], 100.0 + 3 * STRETCH)
    assert lanes.render([present])[0].endswith("9  9")
    lanes.update([present], 100.0 + 1e6 * STRETCH)
    assert lanes.render([present])[0] == " " * (LENGTH - 1) + "9"


def test_a_clock_that_is_set_back_does_no_harm():
    lanes, present = Lanes(), worker("a/1", 10.0)
    assert lanes.render([present]) == [" " * LENGTH], "it was never seen"
    lanes.update([present], 1000.0)
    lanes.update([present], 10.0)
    assert lanes.render([present])[0].endswith("9")
