import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE
from dreamfleet.common.artifacts.controller import Controller, ControllerShape, act
from dreamfleet.common.errors import ControllerError

SHAPE = ControllerShape(features=4, actions=3)


def controller(parameters):
    return Controller(SHAPE, np.asarray(parameters, np.float32), "car-racing", "ab" * 32, {"generation": 3})


def test_a_file_round_trips(tmp_path):
    path = tmp_path / "c.npz"
    one = controller(np.arange(15) / 7)
    one.save(path)
    other = Controller.load(path)
    assert np.array_equal(one.parameters, other.parameters)
    for name in ("shape", "task", "bundle", "provenance", "sha256"):
        assert getattr(one, name) == getattr(other, name)


@pytest.mark.parametrize("hidden", [0, 4])
def test_an_action_is_that_of_the_papers_controller(hidden):
    shape = ControllerShape(features=2, actions=3, hidden=hidden)
    assert shape.size == (4 * 3 + 3 * 5 if hidden else 3 * 3)
    parameters = np.random.default_rng(0).normal(size=shape.size).astype(np.float32)
    *inner, (outer, bias) = shape.unpack(parameters)
    seen = np.ones(2, np.float32)
    for weights, shift in inner:
        seen = np.tanh(weights @ seen + shift)
    squashed = np.tanh(outer @ seen + bias)
    expected = [squashed[0], (squashed[1] + 1) / 2, max(squashed[2], 0)]
    np.testing.assert_allclose(act(shape, parameters, np.ones(2, np.float32), STEERING_GAS_BRAKE), expected, atol=1e-6)
    ((weights, biases),) = SHAPE.unpack(np.arange(15, dtype=np.float32))  # row by row, then biases
    assert np.array_equal(weights[1], [4, 5, 6, 7])
    assert np.array_equal(biases, [12, 13, 14])


def test_what_is_no_controller_is_refused_and_pickled_objects_are_never_loaded(tmp_path):
    for parameters in (np.zeros(14), np.full(15, np.nan), np.full(15, np.inf)):
        with pytest.raises(ControllerError):
            controller(parameters)
    path = tmp_path / "c.npz"
    np.savez(path, parameters=np.array([object()], dtype=object), about=np.array("{}"))
    for content in (path.read_bytes(), b"", b"no archive", b"PK\x03\x04 and then nothing"):
        path.write_bytes(content)
        with pytest.raises(ControllerError, match=r"c\.npz") as error:
            Controller.load(path)
        assert "\n" not in str(error.value)


def test_an_interrupted_save_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "c.npz"
    controller(np.zeros(15)).save(path)
    before = path.read_bytes()
    monkeypatch.setattr(np, "savez", lambda *_args, **_more: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        controller(np.ones(15)).save(path)
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["c.npz"]
