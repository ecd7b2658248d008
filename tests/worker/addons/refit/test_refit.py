"""A controller fitted to another world model.
Tests drive_regression.py, refit_stage.py and refit_verb.py."""

import json
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.car_racing_variants import DEFAULT_VARIANT, Variant
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import ControllerError, DatasetError, UsageError
from dreamfleet.worker.addons.refit import refit_verb as verb
from dreamfleet.worker.addons.refit.drive_regression import DriveArrays, FeatureExtractor, LeastSquaresSums
from dreamfleet.worker.addons.refit.refit import output_bounds, refit
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.drives import ignore, write_drive, write_drives
from tests.support.verbs import run_verb

EYES = VAEConfig(latent=4, channels=(2, 2, 2, 2))
MEMORY = MDNRNNConfig(latent=4, hidden=6)


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


def controller(bundle, features="zh", hidden=0, variant=DEFAULT_VARIANT):
    shape = bundle.shape_of(features, hidden, variant)
    parameters = np.random.default_rng(3).normal(size=shape.size).astype(np.float32)
    return Controller(shape, parameters, "car-racing", bundle.sha256, options=variant.options)


def first_values(chosen, bundle, paths):
    """The outputs of its first layer along drives `(N, T, outputs)`."""
    with_pictures = []
    for path in paths:
        with np.load(path) as drive:
            with_pictures.append(DriveArrays(drive["picture"], drive["action"], drive["reward"]))
    looking = FeatureExtractor(bundle.for_controller(chosen))
    (weights, biases), *_ = chosen.shape.unpack(chosen.parameters)
    values = looking.features(with_pictures, looking.encode_drives(with_pictures)) @ weights.T + biases
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
        assert np.isinf(unbounded).all(), (
            "values that are compared, or are the action, mean something wherever they lie"
        )


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
    for (above, offsets), (same, unchanged) in zip(
        before.shape.unpack(before.parameters)[1:], after.shape.unpack(after.parameters)[1:], strict=True
    ):
        assert (above == same).all()
        assert (offsets == unchanged).all()
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


def test_what_cannot_be_fitted_is_refused(bundles, drives, folder, tmp_path):
    old, new = bundles
    with pytest.raises(UsageError):
        refit(controller(old, variant=Variant(feedback="last")), old, new, drives, ignore)
    wide = write_random_bundle(tmp_path / "wide.zip", 1, VAEConfig(latent=4, picture=96, channels=(2, 2, 2, 2)), MEMORY)
    with pytest.raises(ControllerError):
        refit(controller(old), old, wide, drives, ignore)
    other = write_drive(tmp_path, 0, picture=96)
    with pytest.raises(DatasetError):
        refit(controller(old), old, new, [other], ignore)
    lost = write_drive(tmp_path, 1)
    with np.load(lost) as drive:
        arrays = dict(drive)
    np.savez(lost, **{**arrays, "reward": np.full_like(arrays["reward"], -0.1)})
    with pytest.raises(UsageError):
        refit(controller(old), old, new, [lost], ignore)
    for action in (arrays["action"][:, :2], np.full_like(arrays["action"], np.nan)):
        np.savez(lost, **{**arrays, "action": action})
        with pytest.raises(DatasetError):
            refit(controller(old), old, new, [lost], ignore)
    np.savez(lost, **{**arrays, "picture": arrays["picture"][1:]})
    with pytest.raises(DatasetError):
        refit(controller(old), old, new, [lost], ignore)


def test_the_verb_writes_a_controller_of_the_other_model(bundles, drives, folder, tmp_path, capsys):
    old, new = bundles
    controller(old).save(tmp_path / "before.npz")
    flags = ("--bundle", old.path, "--data", folder / "data", "--out", tmp_path / "after.npz", "--runs-dir", tmp_path)
    assert run_verb(verb, tmp_path / "before.npz", "--to", new.path, *flags, "--episodes", 10, "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    after = Controller.load(tmp_path / "after.npz")
    assert (printed["sha256"], printed["bundle"], printed["drives"]) == (after.sha256, Bundle.open(new.path).sha256, 10)
    assert len(printed["r_squared"]) == 3
    with pytest.raises(UsageError, match="--episodes"):
        run_verb(verb, tmp_path / "before.npz", "--to", new.path, *flags, "--episodes", 1)
    with pytest.raises(UsageError):
        run_verb(verb, tmp_path / "before.npz", "--to", new.path, *flags, "--out", tmp_path)
    with pytest.raises(ControllerError):
        run_verb(verb, tmp_path / "before.npz", "--to", new.path, *flags, "--bundle", new.path)
