import dataclasses

import numpy as np
import pytest

from common.controller import Controller, ControllerShape, act
from common.errors import ControllerError

SHAPE = ControllerShape(features=288)


def parameters(seed=0, shape=SHAPE):
    return np.random.default_rng(seed).normal(size=shape.size).astype(np.float32)


@pytest.fixture
def controller():
    return Controller(SHAPE, parameters(), "car-racing", "ab" * 32, {"run": "a", "generation": 7})


def test_the_papers_controller_has_867_parameters():
    assert SHAPE.size == 867


def test_the_vector_is_weights_row_by_row_then_biases():
    vector = np.arange(867, dtype=np.float32)
    weights, biases = SHAPE.unpack(vector)
    assert weights[1, 2] == 288 + 2
    assert biases.tolist() == [864, 865, 866]


def test_unpacking_many_equals_unpacking_each():
    many = np.stack([parameters(seed) for seed in range(4)])
    weights, biases = SHAPE.unpack(many)
    for index, vector in enumerate(many):
        assert np.array_equal(weights[index], SHAPE.unpack(vector)[0])
        assert np.array_equal(biases[index], SHAPE.unpack(vector)[1])


@pytest.mark.parametrize("size", [0, 866, 868])
def test_a_vector_of_another_size_is_refused_with_both_sizes(size):
    with pytest.raises(ControllerError, match=rf"{size} parameters.*867"):
        SHAPE.unpack(np.zeros(size, dtype=np.float32))


def test_zero_parameters_steer_straight_with_half_gas():
    action = act(SHAPE, np.zeros(867, dtype=np.float32), np.ones(288, dtype=np.float32))
    assert action.tolist() == [0.0, 0.5, 0.0]


@pytest.mark.parametrize(("bias", "expected"), [(50.0, [1, 1, 1]), (-50.0, [-1, 0, 0])])
def test_actions_reach_their_bounds_and_no_further(bias, expected):
    vector = np.zeros(867, dtype=np.float32)
    vector[864:] = bias
    assert act(SHAPE, vector, np.zeros(288, dtype=np.float32)).tolist() == expected


def test_each_action_has_its_own_row_and_bias():
    features = np.random.default_rng(1).normal(size=288).astype(np.float32)
    vector = parameters() * 0.05
    weights, biases = SHAPE.unpack(vector.astype(np.float64))
    steer, gas, brake = (np.tanh(weights[row] @ features + biases[row]) for row in range(3))
    expected = [steer, (gas + 1) / 2, min(max(brake, 0), 1)]
    assert np.allclose(act(SHAPE, vector, features), expected, atol=1e-6)


def test_a_saved_controller_loads_equal(tmp_path, controller):
    controller.save(tmp_path / "c.npz")
    loaded = Controller.load(tmp_path / "c.npz")
    assert np.array_equal(loaded.parameters, controller.parameters)
    assert loaded.sha256 == controller.sha256
    fields = ("shape", "task", "bundle", "provenance")
    assert all(getattr(loaded, name) == getattr(controller, name) for name in fields)


def test_saving_twice_gives_equal_files(tmp_path, controller):
    for name in ("a.npz", "b.npz"):
        controller.save(tmp_path / name)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_the_hash_is_of_the_parameters(controller):
    changed = controller.parameters.copy()
    changed[-1] = np.nextafter(changed[-1], np.float32(9))
    assert dataclasses.replace(controller, parameters=changed).sha256 != controller.sha256
    assert dataclasses.replace(controller, provenance={}).sha256 == controller.sha256


@pytest.mark.parametrize(
    "wrong",
    [np.zeros(866, np.float32), np.zeros(867, np.float64), np.zeros((1, 867), np.float32), np.full(867, np.nan, "f4")],
)
def test_parameters_that_do_not_fit_are_refused(controller, wrong):
    with pytest.raises(ControllerError):
        dataclasses.replace(controller, parameters=wrong)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(ControllerError, match="no controller at"):
        Controller.load(tmp_path / "absent.npz")


def test_another_format_version_is_refused(tmp_path, controller, monkeypatch):
    with monkeypatch.context() as later:
        later.setattr("common.controller.FORMAT", 99)
        controller.save(tmp_path / "c.npz")
    with pytest.raises(ControllerError, match="99"):
        Controller.load(tmp_path / "c.npz")


def test_a_pickled_array_is_never_unpickled(tmp_path):
    np.savez(tmp_path / "c.npz", parameters=np.array([print], dtype=object), about=np.array("{}"))
    with pytest.raises(ControllerError):
        Controller.load(tmp_path / "c.npz")


def test_no_damage_to_any_byte_raises_another_kind_of_error(tmp_path, controller):
    path = tmp_path / "c.npz"
    controller.save(path)
    data = path.read_bytes()
    for position in range(0, len(data), 5):
        damaged = bytearray(data)
        damaged[position] ^= 0xFF
        path.write_bytes(damaged)
        try:
            loaded = Controller.load(path)
        except ControllerError:
            continue
        assert np.array_equal(loaded.parameters, controller.parameters), position


@pytest.mark.parametrize("share", [0.0, 0.2, 0.6, 0.99])
def test_a_truncated_file_is_refused(tmp_path, controller, share):
    path = tmp_path / "c.npz"
    controller.save(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(ControllerError):
        Controller.load(path)
