"""Figures of a world model under a controller that repeats its choices. Tests drive_dreams.py."""

import numpy as np
import pytest

from dreamfleet.common.artifacts.car_racing_variants import Variant
from dreamfleet.worker.addons.inspection.disturbed_rollouts import DisturbedDriveConfig, record_disturbed_drives
from dreamfleet.worker.addons.inspection.drive_dreams import DreamSegment, DriveDreamer
from dreamfleet.worker.addons.inspection.measurements import DriverChoice
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState
from tests.support.bundles import write_random_bundle
from tests.support.variants import controller_of

VARIANT = Variant(pedals="one", pedal_shift=0.25, decide_every=3, feedback="last")


def witnessed(observing_model, own, noise):
    """A drive of eleven steps by a controller of `own`, observed by `watching`."""
    driving = DriverChoice(controller_of(own.with_controllers(None, VARIANT)), own)
    recurrent = RecurrentState(driving.observing_model(observing_model))
    drives = record_disturbed_drives(
        observing_model, recurrent, driving.actors(observing_model, recurrent), DisturbedDriveConfig(noise, steps=11)
    )
    drive = next(drives)
    drives.close()
    return drive, driving.controller


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_choice_is_held_whatever_is_pushed_meanwhile(random_bundle, noise):
    drive, _ = witnessed(random_bundle, random_bundle, noise)
    assert drive.state[:, -1].tolist() == [0, 1, 2] * 3 + [0, 1]
    choices = drive.state[:, -7:-4]
    for begun in (1, 4, 7):
        assert (choices[begun : begun + 3] == choices[begun]).all()
    calm = np.array_equal(drive.action[:9].reshape(3, 3, 3)[:, 0], choices[[1, 4, 7]])
    assert calm == (noise == 0)


def test_a_dream_that_begins_between_two_choices_holds_on_to_the_one_before(random_bundle):
    drive, controller = witnessed(random_bundle, random_bundle, 0.0)
    dreamer, begun = DriveDreamer(random_bundle, controller, 1.0, 2), DreamSegment(drive, 4, 6)
    own, same = (dreamer.dream(begun, own=each)[0] for each in (True, False))
    assert np.array_equal(own[:, :3], same[:, :3]), "steps 4 and 5 do what step 3 chose"
    assert not np.array_equal(own[:, 4:], same[:, 4:])


def test_another_world_model_may_look_on(random_bundle, tmp_path):
    other = write_random_bundle(tmp_path / "other.zip", seed=9)
    drive, _ = witnessed(other, random_bundle, 0.0)
    assert drive.state.shape == (11, 512)
    assert np.array_equal(drive.action, witnessed(random_bundle, random_bundle, 0.0)[0].action)
