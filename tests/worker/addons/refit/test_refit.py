"""A controller fitted to another world model, and a subspace of features that predict its drives.
Tests drive_regression.py, fit_subspace.py, stages.py, refit_verb.py and subspace_verb.py."""

import json
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import Continuous, Discrete
from dreamfleet.common.artifacts.car_racing_variants import Variant
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.errors import ControllerError, DatasetError, UsageError
from dreamfleet.common.runs.lookup import find_bundle
from dreamfleet.worker.addons.refit import refit_verb as verb
from dreamfleet.worker.addons.refit import subspace_verb
from dreamfleet.worker.addons.refit.drive_regression import FeatureExtractor, LeastSquaresSums, load_in_batches
from dreamfleet.worker.addons.refit.fit_subspace import PredictionTarget, find_subspace, make_targets
from dreamfleet.worker.addons.refit.refit import output_bounds, refit
from dreamfleet.worker.tasks.api import World
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.drives import grey, ignore, write_drive, write_drives
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


@pytest.fixture(scope="module")
def bundle(bundles):
    return bundles[0]


@pytest.fixture(scope="module")
def steered_drives(folder):
    """Drives in which the steering slowly follows the pictures, with a reward at each third step."""
    paths = []
    for number in range(20):
        action = np.random.default_rng(number).uniform(0, 1, (120, 3)).astype(np.float32)
        action[:, 0] = np.sin(np.arange(120) / 15 + number)
        paths.append(
            write_drive(folder / "steered", number, 120, pictures=grey(127 + 100 * action[:, 0]), action=action)
        )
    return paths


@pytest.fixture(scope="module")
def held_out(bundle, steered_drives):
    """The last five drives, and the world model's features along them `(5, 120, 10)`."""
    ((_, loaded),) = load_in_batches(steered_drives[15:], 3)
    looking = FeatureExtractor(bundle)
    return loaded, looking.features(loaded, looking.encode_drives(loaded))


def test_a_target_is_the_mean_of_the_steps_to_come():
    values = np.array([[1.0], [2.0], [-4.0], [8.0], [0.0]])
    sums = np.concatenate([np.zeros((1, 1)), np.cumsum(values, axis=0)])
    assert PredictionTarget("a", 0, (1, 3)).values(sums).tolist()[:3] == [-1, 2, 4]
    assert PredictionTarget("a", 0, (1, 3), size=True).values(sums).tolist()[:3] == [1, 2, 4]
    assert PredictionTarget("a", 0, (0, 1)).values(sums).tolist() == [1, 2, -4, 8, 0]


def test_all_windows_are_asked_of_what_goes_both_ways_alone():
    actions = Continuous.between([-1, 0], [1, 1])
    assert make_targets(World(actions), 2)[0].name == "action 1 0-3"
    names = [each.name for each in make_targets(World(actions, action_names=("steer", "gas")), 2)]
    assert names[:2] == ["steer 0-3", "steer 3-8"]
    assert [each for each in names if each.startswith("gas")] == ["gas 0-5"]
    assert names[-3:] == ["reward 0-6", "reward 6-20", "reward 20-40"]
    assert len(names) == 16
    assert len(make_targets(World(Discrete(3)), 3)) == 6


def test_its_features_predict_held_out_drives_and_have_one_size(bundle, steered_drives, held_out):
    found, (driven, seen) = find_subspace(bundle, steered_drives[:15], ignore), held_out
    subspace = found.subspace
    assert (subspace.bundle, found.drives) == (bundle.sha256, 15)
    assert all(each >= 0.05 for each in found.r_squared)
    features = (seen @ subspace.weights.T + subspace.offsets)[:, 20:80]
    np.testing.assert_allclose(features.mean(axis=(0, 1)), 0, atol=0.3)
    np.testing.assert_allclose(features.std(axis=(0, 1)), 1, atol=0.3)
    steering = np.stack([each.action[20:80, 0] for each in driven])
    predicted = features[..., subspace.names.index("steer 0-3")]
    assert np.corrcoef(predicted.ravel(), steering.ravel())[0, 1] > 0.8


def test_views_are_directions_that_predict_the_models_later_state(bundle, steered_drives, held_out):
    plain, wide = (find_subspace(bundle, steered_drives[:15], ignore, views) for views in (0, 3))
    count = len(plain.subspace.names)
    assert wide.subspace.names[:count] == plain.subspace.names
    views = len(wide.subspace.names) - count
    assert 1 <= views <= 3, "as many as are predictable"
    assert wide.subspace.names[count:] == tuple(f"view {number} 15-16" for number in range(1, views + 1))
    np.testing.assert_array_equal(wide.subspace.weights[:count], plain.subspace.weights)
    _, seen = held_out
    values = (seen @ wide.subspace.weights[count:].T + wide.subspace.offsets[count:])[:, 20:80].reshape(300, views)
    design = np.column_stack([seen[:, 35:95].reshape(300, -1), np.ones(300)])
    np.testing.assert_allclose(values.std(axis=0), 1, atol=0.3)
    for column, r_squared in zip(values.T, wide.r_squared[count:], strict=True):
        missed = column - design @ np.linalg.lstsq(design, column, rcond=None)[0]
        assert 1 - missed.var() / column.var() >= r_squared - 0.2, "it is predictable from the later state, too"
    assert all(0.05 <= each <= 1 for each in wide.r_squared)
    everything = find_subspace(bundle, steered_drives[:15], ignore, 1000)
    assert len(everything.subspace.names) <= count + 10, "no more than [z, h] has"


def test_unpredictable_drives_are_refused(bundle, steered_drives, tmp_path):
    short = [write_drive(tmp_path / "short", number, steps=30) for number in range(5)]
    ones = {"action": np.ones((150, 3), np.float32), "reward": np.ones(150, np.float32)}
    always = [write_drive(tmp_path / "always", number, 150, **ones) for number in range(10)]
    wide = [write_drive(tmp_path / "wide", 0, picture=96)]
    for error, paths in (
        (UsageError, short),
        (UsageError, always),
        (UsageError, steered_drives[:4]),
        (DatasetError, wide),
    ):
        with pytest.raises(error):
            find_subspace(bundle, paths, ignore)


def test_the_features_of_a_rounded_world_model_fit_the_whole_one_too(steered_drives):
    assert find_subspace(find_bundle("tiny-int8"), steered_drives, ignore).subspace.bundle == find_bundle("tiny").sha256


def test_the_verb_writes_one_and_prints_what_it_predicts(bundle, steered_drives, folder, tmp_path, capsys):
    def call(*more):
        return run_verb(subspace_verb, bundle.path, "--data", folder / "steered", "--out", tmp_path / "few.npz", *more)

    assert call("--json") == 0
    printed, subspace = json.loads(capsys.readouterr().out), Subspace.load(tmp_path / "few.npz")
    assert (printed["sha256"], printed["bundle"], printed["drives"]) == (subspace.sha256, bundle.sha256, 20)
    assert tuple(printed["features"]) == subspace.names
    assert len(printed["r_squared"]) == len(subspace.names)
    assert call() == 0
    assert "steer 0-3" in capsys.readouterr().out
    assert Subspace.load(tmp_path / "few.npz").sha256 == subspace.sha256, "equal drives make equal subspaces"
    for error, more in (
        (UsageError, ("--episodes", 4)),
        (UsageError, ("--views", -1)),
        (UsageError, ("--out", tmp_path)),
        (DatasetError, ("--data", tmp_path / "nothing")),
    ):
        with pytest.raises(error):
            call(*more)
