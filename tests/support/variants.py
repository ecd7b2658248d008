"""CarRacing variants, and controllers of any bundle."""

import numpy as np

from dreamfleet.common.artifacts.car_racing_variants import Variant
from dreamfleet.common.artifacts.controller import Controller

VARIANTS = {
    "half pedals": Variant(pedals="half"),
    "one pedal": Variant(pedals="one"),
    "shifted pedal": Variant(pedals="one", pedal_shift=0.25),
    "every third": Variant(decide_every=3),
    "feedback": Variant(feedback="last"),
    "linear": Variant(actions="linear"),
    "linear, held and seen": Variant(actions="linear", decide_every=3, feedback="last"),
    "discrete": Variant(actions="discrete"),
    "discrete, held and seen": Variant(actions="discrete", decide_every=3, feedback="last"),
    "all": Variant(pedals="one", decide_every=3, feedback="last"),
}


def vectors(bundle, count, seed=4, scale=0.3):
    """Random parameters `(count, size)` for the bundle's controllers."""
    random = np.random.default_rng(seed)
    return random.normal(0, scale, (count, bundle.controller_shape.size)).astype(np.float32)


def controller_of(bundle, task="car-racing", seed=4):
    """A random controller of the bundle, under its own options."""
    (parameters,) = vectors(bundle, 1, seed)
    driving = bundle.driving
    return Controller(bundle.controller_shape, parameters, task, bundle.sha256, {}, driving.options, driving.version)
