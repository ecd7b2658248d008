"""A controller and its world model as one ONNX graph."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from dreamfleet import Controller, UsageError, find_controller
from dreamfleet.common.runs.lookup import find_bundle_of
from dreamfleet.worker.addons.card.driver_graph import export_driver, largest_difference
from dreamfleet.worker.worldmodel.inference import open_graph
from dreamfleet.worker.worldmodel.mdnrnn_config import REWARDED
from tests.support.bundles import write_random_bundle
from tests.support.dreams import write_bundle_of
from tests.support.variants import VARIANTS, controller_of, vectors


def difference(controller, bundle):
    return largest_difference(bundle, controller, export_driver(bundle, controller))


@pytest.mark.parametrize("name", ["tiny", "real", "dream", "takecover", "takecover-real"])
def test_what_ships_acts_by_one_graph_to_the_bit(name):
    controller = find_controller(name)
    assert difference(controller, find_bundle_of(controller, None)) == 0


def test_every_shape_of_controller_acts_to_the_bit(random_bundle, tmp_path):
    for features, hidden in product(("z", "zh"), (0, 5)):
        own = random_bundle.with_controllers(random_bundle.shape_of(features, hidden))
        assert difference(controller_of(own), random_bundle) == 0
    attentive = write_random_bundle(tmp_path / "attentive.zip", rnn=replace(REWARDED, window=3, dropout=0.1))
    assert difference(controller_of(attentive), attentive) == 0
    bundle = write_bundle_of("groups", tmp_path / "groups.zip")
    for options in ("", '{"decide_every": 3, "feedback": "last"}'):
        own = bundle.with_options(None, options)
        about = own.controller_shape, vectors(own, 1)[0], bundle.manifest.task, bundle.sha256
        assert difference(Controller(*about, options=options), bundle) == 0


@pytest.mark.parametrize("name", VARIANTS)
def test_a_variant_acts_as_numpy_computes_it(random_bundle, name):
    """Its choices to the bit; of continuous actions NumPy's last bits differ from ONNX Runtime's."""
    controller = controller_of(random_bundle.with_controllers(None, VARIANTS[name]))
    exact = VARIANTS[name].actions == "discrete"
    found = difference(controller, random_bundle)
    assert found == 0 if exact else found < 1e-5


def test_the_graph_has_two_inputs_and_a_batch(random_bundle):
    controller = controller_of(random_bundle)
    graph = open_graph(export_driver(random_bundle, controller), threads=1)
    assert [each.name for each in graph.get_inputs()] == ["picture", "state"]
    assert [each.name for each in graph.get_outputs()] == ["action", "next_state"]
    pictures = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), np.uint8)
    state = np.zeros((3, graph.get_inputs()[1].shape[1]), np.float32)
    together, _ = graph.run(None, {"picture": pictures, "state": state})
    alone, _ = graph.run(None, {"picture": pictures[1:2], "state": state[1:2]})
    assert np.array_equal(together[1:2], alone)


def test_what_a_picture_alone_cannot_drive_is_refused(tmp_path):
    rewarded = write_random_bundle(tmp_path / "rewarded.zip", rnn=replace(REWARDED, previous_reward=True))
    with pytest.raises(UsageError):
        export_driver(rewarded, controller_of(rewarded))
