"""A controller fitted to another world model.
Tests drive_regression.py, stages.py and refit_verb.py."""

import json
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.car_racing_variants import Variant
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import ControllerError, DatasetError, UsageError
from dreamfleet.worker.addons.refit import refit_verb as verb
from dreamfleet.worker.addons.refit.drive_regression import FeatureExtractor, LeastSquaresSums, load_in_batches
from dreamfleet.worker.addons.refit.refit import output_bounds, refit
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.drives import ignore, write_drive, write_drives
from tests.support.verbs import run_verb

EYES = VAEConfig(latent=4, channels=(2, 2, 2, 2))
MEMORY = MDNRNNConfig(latent=4, hidden=6)
PLAIN = Variant()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("refit")


@pytest.fixture(scope="module")
def bundles(folder):
    """Two random world models with different encoders and MDN-RNNs."""
    return [write_random_bundle(folder / f"{seed}.zip", seed, EYES, MEMORY) for seed in (1, 2)]


@pytest.fixture(scope="module")
def drives(folder):
    return write_drives(folder / "data", episodes=20, steps=60)


def controller(bundle, features="zh", hidden=0, variant=PLAIN):
    shape = bundle.shape_of(features, hidden, variant)
    parameters = np.random.default_rng(3).normal(size=shape.size).astype(np.float32)
    return Controller(shape, parameters, "car-racing", bundle.sha256, options=variant.options)


def first_values(chosen, bundle, paths):
    """The outputs of its first layer along drives `(N, T, outputs)`."""
    ((_, drives),) = load_in_batches(paths, 3)
    looking = FeatureExtractor(bundle.for_controller(chosen))
    (weights, biases), *_ = chosen.shape.unpack(chosen.parameters)
    values = looking.features(drives, looking.encode_drives(drives)) @ weights.T + biases
    return np.clip(values, *output_bounds(chosen, bundle))


def test_what_lies_behind_an_actions_bound_is_kept_near_it(bundles):
    lowest, highest = output_bounds(controller(bundles[0]), bundles[0])
    np.testing.assert_allclose(lowest, [-2.5, -2.5, -0.3])  # only the brake is cut off, below 0
    np.testing.assert_allclose(highest, [2.5, 2.5, 2.5])
    for other in (controller(bundles[0], hidden=5), controller(bundles[0], variant=Variant(pedals="one"))):
        lowest, highest = output_bounds(other, bundles[0])
        assert (set(lowest), set(highest)) == ({-2.5}, {2.5})
    for actions in ("discrete", "linear"):
        unbounded = output_bounds(controller(bundles[0], variant=Variant(actions=actions)), bundles[0])
        assert np.isinf(unbounded).all(), "values that are compared, or are the action"


@pytest.mark.parametrize("features", ["z", "zh"])
@pytest.mark.parametrize("hidden", [0, 5])
def test_it_chooses_by_other_eyes_much_as_it_chose(bundles, drives, features, hidden):
    old, new = bundles
    before = controller(old, features, hidden)
    counts = []
    found = refit(before, old, new, drives[:16], counts.append)
    after = found.controller
    assert (after.bundle, after.shape, after.task) == (new.sha256, before.shape, before.task)
    assert after.provenance == {"refitted_from": before.sha256, "of_world_model": old.sha256}
    assert found.drives == 16
    assert 16 * 55 < found.steps < 16 * 60  # nothing is known behind a drive's last reward
    assert counts == [16]
    upper, same = (each.shape.unpack(each.parameters)[1:] for each in (before, after))
    assert all(all(map(np.array_equal, *layers)) for layers in zip(upper, same, strict=True))
    wanted = first_values(before, old, drives[16:])
    fitted, moved = (first_values(each, new, drives[16:]) for each in (after, replace(before, bundle=new.sha256)))
    assert np.square(fitted - wanted).mean() < 0.2 * np.square(moved - wanted).mean()


def test_the_model_that_it_has_leaves_it_as_it_is(bundles, drives):
    before = controller(bundles[0])
    assert refit(before, bundles[0], bundles[0], drives, ignore).controller == before


def test_least_squares_find_a_map_and_how_much_it_explains():
    random = np.random.default_rng(0)
    inputs = random.normal(size=(200, 3)).astype(np.float32)
    weights, noise = random.normal(size=(4, 2)), random.normal(size=(200, 2)) * [0, 1]
    targets = inputs @ weights[:3] + weights[3] + noise
    parts = LeastSquaresSums.of(inputs[:90], targets[:90]) + LeastSquaresSums.of(inputs[90:], targets[90:])
    solved = parts.solve(0)
    assert np.allclose(solved[:, 0], weights[:, 0])
    left = targets[:, 1] - inputs @ solved[:3, 1] - solved[3, 1]
    assert np.allclose(parts.r_squared(solved), [1, 1 - left.var() / targets[:, 1].var()])
    assert np.abs(parts.solve(1)[:3]).sum() < np.abs(solved[:3]).sum()
    assert np.isnan(LeastSquaresSums.of(inputs, np.ones((200, 1))).r_squared(np.zeros((4, 1)))).all()


def test_what_cannot_be_fitted_is_refused(bundles, drives, tmp_path):
    old, new = bundles
    with pytest.raises(UsageError):
        refit(controller(old, variant=Variant(feedback="last")), old, new, drives, ignore)
    wide = write_random_bundle(tmp_path / "wide.zip", 1, replace(EYES, picture=96), MEMORY)
    with pytest.raises(ControllerError):
        refit(controller(old), old, wide, drives, ignore)
    for error, changed in (
        (DatasetError, {"picture": 96}),
        (DatasetError, {"pictures": np.zeros((11, 64, 64, 3), np.uint8)}),
        (DatasetError, {"actions": 2}),
        (DatasetError, {"action": np.full((12, 3), np.nan, np.float32)}),
        (UsageError, {"reward": np.full(12, -0.1, np.float32)}),  # it is lost from the first step on
    ):
        with pytest.raises(error):
            refit(controller(old), old, new, [write_drive(tmp_path, 0, **changed)], ignore)


def test_the_verb_writes_a_controller_of_the_other_model(bundles, drives, folder, tmp_path, capsys):
    old, new = bundles
    controller(old).save(tmp_path / "before.npz")

    def call(*more):
        return run_verb(
            verb, tmp_path / "before.npz", "--to", new.path, "--bundle", old.path, "--data", folder / "data", "--out",
            tmp_path / "after.npz", "--runs-dir", tmp_path, *more,
        )  # fmt: skip

    assert call("--episodes", 10, "--json") == 0
    printed, after = json.loads(capsys.readouterr().out), Controller.load(tmp_path / "after.npz")
    assert (printed["sha256"], printed["bundle"], printed["drives"]) == (after.sha256, new.sha256, 10)
    assert len(printed["r_squared"]) == 3
    with pytest.raises(UsageError, match="--episodes"):
        call("--episodes", 1)
    with pytest.raises(UsageError):
        call("--out", tmp_path)
    with pytest.raises(ControllerError):
        call("--bundle", new.path)
