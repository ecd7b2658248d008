import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE
from dreamfleet.common.artifacts.controller import Controller, ControllerShape, act
from dreamfleet.common.errors import ControllerError

SHAPE = ControllerShape(features=4, actions=3)


def controller(parameters):
    return Controller(SHAPE, np.asarray(parameters, np.float32), "car-racing", "ab" * 32, {"generation": 3})


def test_the_papers_controller_has_867_parameters():
    assert ControllerShape(features=32 + 256, actions=3).size == 867


def test_a_file_round_trips(tmp_path):
    path = tmp_path / "c.npz"
    one = controller(np.arange(15) / 7)
    one.save(path)
    other = Controller.load(path)
    assert np.array_equal(one.parameters, other.parameters)
    assert all(
        getattr(one, name) == getattr(other, name) for name in ("shape", "task", "bundle", "provenance", "sha256")
    )


def test_zero_parameters_drive_straight_at_half_gas():
    action = act(SHAPE, np.zeros(15, np.float32), np.ones(4, np.float32), STEERING_GAS_BRAKE)
    assert action.tolist() == [0.0, 0.5, 0.0]


def test_weights_are_row_by_row_then_biases():
    ((weights, biases),) = SHAPE.unpack(np.arange(15, dtype=np.float32))
    assert np.array_equal(weights[1], [4, 5, 6, 7])
    assert np.array_equal(biases, [12, 13, 14])


def test_a_hidden_layer():
    shape = ControllerShape(features=2, actions=3, hidden=4)
    assert shape.size == 4 * 3 + 3 * 5
    parameters = np.random.default_rng(0).normal(size=27).astype(np.float32)
    (inner, shift), (outer, bias) = shape.unpack(parameters)
    assert (inner.shape, shift.shape, outer.shape, bias.shape) == ((4, 2), (4,), (3, 4), (3,))
    squashed = np.tanh(outer @ np.tanh(inner @ np.ones(2, np.float32) + shift) + bias)
    expected = [squashed[0], (squashed[1] + 1) / 2, max(squashed[2], 0)]
    np.testing.assert_allclose(act(shape, parameters, np.ones(2, np.float32), STEERING_GAS_BRAKE), expected, atol=1e-6)


@pytest.mark.parametrize("parameters", [np.zeros(14), np.full(15, np.nan), np.full(15, np.inf)])
def test_parameters_that_do_not_fit_are_refused(parameters):
    with pytest.raises(ControllerError):
        controller(parameters)


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 and then nothing"])
def test_a_damaged_file_is_a_one_line_error(tmp_path, content):
    path = tmp_path / "c.npz"
    path.write_bytes(content)
    with pytest.raises(ControllerError, match=r"c\.npz") as error:
        Controller.load(path)
    assert "\n" not in str(error.value)


def test_a_file_with_pickled_objects_is_never_loaded(tmp_path):
    path = tmp_path / "c.npz"
    np.savez(path, parameters=np.array([object()], dtype=object), about=np.array("{}"))
    with pytest.raises(ControllerError):
        Controller.load(path)


def test_an_interrupted_save_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "c.npz"
    controller(np.zeros(15)).save(path)
    before = path.read_bytes()
    monkeypatch.setattr(np, "savez", lambda *_args, **_more: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        controller(np.ones(15)).save(path)
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["c.npz"]
