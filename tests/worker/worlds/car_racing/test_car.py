"""The native module reads Box2D's bodies and contacts in memory, if they lie there as it assumes."""

from array import array

import numpy as np
import pytest

from dreamfleet.worker.worlds.car_racing import car
from dreamfleet.worker.worlds.car_racing.environment import CarRacing, is_native_available

needs_native = pytest.mark.skipif(not is_native_available(), reason="no native module was built")


@needs_native
def test_a_box2d_that_keeps_its_bodies_elsewhere_is_not_read(monkeypatch, caplog):
    monkeypatch.setattr(car._native, "knows", lambda _contact: False)
    assert car.find_native.__wrapped__() is None
    assert [each.levelname for each in caplog.records] == ["WARNING"]


@needs_native
def test_what_is_read_is_what_box2d_says():
    environment = CarRacing(preprocessing="box-64")
    environment.reset(seed=1)
    for _ in range(30):
        environment.step(np.array([0.3, 1.0, 0.0]))
    seen = array("d", bytes(8 * 20))
    car.find_native().look(seen, environment.car)
    bodies = (*environment.car.wheels, environment.car.hull)
    told = [(*body.position, body.angle, getattr(body, "phase", 0.0)) for body in bodies]
    assert np.array_equal(np.reshape(seen, (5, 4)), told)


@needs_native
def test_a_body_that_is_none_is_an_error():
    with pytest.raises(AttributeError, match="this"):
        car.find_native().touch(object(), object(), True)
