"""A subspace of features that predict a driver's actions and rewards.
Tests subspace_verb.py."""

import json

import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import Continuous, Discrete
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.runs.lookup import find_bundle
from dreamfleet.worker.addons.refit import subspace_verb as verb
from dreamfleet.worker.addons.refit.drive_regression import FeatureExtractor, load_in_batches
from dreamfleet.worker.addons.refit.fit_subspace import PredictionTarget, find_subspace, make_targets
from dreamfleet.worker.tasks.api import World
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.drives import grey, ignore, write_drive
from tests.support.verbs import run_verb


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("subspace")


@pytest.fixture(scope="module")
def bundle(folder):
    eyes, memory = VAEConfig(latent=4, channels=(2, 2, 2, 2)), MDNRNNConfig(latent=4, hidden=6)
    return write_random_bundle(folder / "model.zip", 1, eyes, memory)


@pytest.fixture(scope="module")
def drives(folder):
    """Drives in which the steering slowly follows the pictures, with a reward at each third step."""
    paths = []
    for number in range(20):
        action = np.random.default_rng(number).uniform(0, 1, (120, 3)).astype(np.float32)
        action[:, 0] = np.sin(np.arange(120) / 15 + number)
        paths.append(write_drive(folder / "data", number, 120, pictures=grey(127 + 100 * action[:, 0]), action=action))
    return paths


@pytest.fixture(scope="module")
def held_out(bundle, drives):
    """The last five drives, and the world model's features along them `(5, 120, 10)`."""
    ((_, loaded),) = load_in_batches(drives[15:], 3)
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


def test_its_features_predict_held_out_drives_and_have_one_size(bundle, drives, held_out):
    found, (driven, seen) = find_subspace(bundle, drives[:15], ignore), held_out
    subspace = found.subspace
    assert (subspace.bundle, found.drives) == (bundle.sha256, 15)
    assert all(each >= 0.05 for each in found.r_squared)
    features = (seen @ subspace.weights.T + subspace.offsets)[:, 20:80]
    np.testing.assert_allclose(features.mean(axis=(0, 1)), 0, atol=0.3)
    np.testing.assert_allclose(features.std(axis=(0, 1)), 1, atol=0.3)
    steering = np.stack([each.action[20:80, 0] for each in driven])
    predicted = features[..., subspace.names.index("steer 0-3")]
    assert np.corrcoef(predicted.ravel(), steering.ravel())[0, 1] > 0.8


def test_views_are_directions_that_predict_the_models_later_state(bundle, drives, held_out):
    plain, wide = (find_subspace(bundle, drives[:15], ignore, views) for views in (0, 3))
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
    everything = find_subspace(bundle, drives[:15], ignore, 1000)
    assert len(everything.subspace.names) <= count + 10, "no more than [z, h] has"


def test_unpredictable_drives_are_refused(bundle, drives, tmp_path):
    short = [write_drive(tmp_path / "short", number, steps=30) for number in range(5)]
    ones = {"action": np.ones((150, 3), np.float32), "reward": np.ones(150, np.float32)}
    always = [write_drive(tmp_path / "always", number, 150, **ones) for number in range(10)]
    wide = [write_drive(tmp_path / "wide", 0, picture=96)]
    for error, paths in ((UsageError, short), (UsageError, always), (UsageError, drives[:4]), (DatasetError, wide)):
        with pytest.raises(error):
            find_subspace(bundle, paths, ignore)


def test_the_features_of_a_rounded_world_model_fit_the_whole_one_too(drives):
    assert find_subspace(find_bundle("tiny-int8"), drives, ignore).subspace.bundle == find_bundle("tiny").sha256


def test_the_verb_writes_one_and_prints_what_it_predicts(bundle, drives, folder, tmp_path, capsys):
    def call(*more):
        return run_verb(verb, bundle.path, "--data", folder / "data", "--out", tmp_path / "few.npz", *more)

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
