"""A subspace of features that predict a driver's actions and rewards.
Tests subspace_stage.py and subspace_verb.py."""

import json

import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import Continuous, Discrete
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.runs.lookup import find_bundle
from dreamfleet.worker.addons.refit import subspace_verb as verb
from dreamfleet.worker.addons.refit.drive_regression import DriveArrays, FeatureExtractor
from dreamfleet.worker.addons.refit.fit_subspace import PredictionTarget, find_subspace, make_targets
from dreamfleet.worker.tasks.api import World
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.drives import ignore, write_drive
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
        path = write_drive(folder / "data", number, steps=120)
        with np.load(path) as drive:
            arrays = dict(drive)
        arrays["action"][:, 0] = np.sin(np.arange(120) / 15 + number)
        arrays["picture"][:] = (127 + 100 * arrays["action"][:, 0]).astype(np.uint8)[:, None, None, None]
        np.savez(path, **arrays)
        paths.append(path)
    return paths


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


def test_its_features_predict_held_out_drives_and_have_one_size(bundle, drives):
    found = find_subspace(bundle, drives[:15], ignore)
    subspace = found.subspace
    assert (subspace.bundle, found.drives) == (bundle.sha256, 15)
    assert all(each >= 0.05 for each in found.r_squared)
    assert "steer 0-3" in subspace.names
    looked, steering = [], []
    for path in drives[15:]:
        with np.load(path) as arrays:
            drive = DriveArrays(arrays["picture"], arrays["action"], arrays["reward"])
        looking = FeatureExtractor(bundle)
        looked.append(looking.features([drive], looking.encode_drives([drive]))[0][20:80])
        steering.append(drive.action[20:80, 0])
    features = np.concatenate(looked) @ subspace.weights.T + subspace.offsets
    np.testing.assert_allclose(features.mean(axis=0), 0, atol=0.3)
    np.testing.assert_allclose(features.std(axis=0), 1, atol=0.3)
    values = features[:, subspace.names.index("steer 0-3")]
    assert np.corrcoef(values, np.concatenate(steering))[0, 1] > 0.8


def test_views_are_directions_that_predict_the_models_later_state(bundle, drives):
    plain, wide = (find_subspace(bundle, drives[:15], ignore, views) for views in (0, 3))
    count = len(plain.subspace.names)
    assert wide.subspace.names[:count] == plain.subspace.names
    views = len(wide.subspace.names) - count
    assert 1 <= views <= 3, "as many as are predictable"
    assert wide.subspace.names[count:] == tuple(f"view {number} 15-16" for number in range(1, views + 1))
    np.testing.assert_array_equal(wide.subspace.weights[:count], plain.subspace.weights)
    looking, now, then = FeatureExtractor(bundle), [], []
    for path in drives[15:]:
        with np.load(path) as arrays:
            drive = DriveArrays(arrays["picture"], arrays["action"], arrays["reward"])
        seen = looking.features([drive], looking.encode_drives([drive]))[0]
        now.append(seen[20:80] @ wide.subspace.weights[count:].T + wide.subspace.offsets[count:])
        then.append(seen[35:95])
    values, later = np.concatenate(now), np.concatenate(then)
    np.testing.assert_allclose(values.std(axis=0), 1, atol=0.3)
    for column, r_squared in zip(values.T, wide.r_squared[count:], strict=True):
        design = np.column_stack([later, np.ones(len(later))])
        missed = column - design @ np.linalg.lstsq(design, column, rcond=None)[0]
        assert 1 - missed.var() / column.var() >= r_squared - 0.2, "it is predictable from the later state, too"
    assert all(0.05 <= each <= 1 for each in wide.r_squared)
    everything = find_subspace(bundle, drives[:15], ignore, 1000)
    assert len(everything.subspace.names) <= count + 10, "no more than [z, h] has"


def test_unpredictable_drives_are_refused(bundle, drives, tmp_path):
    with pytest.raises(UsageError):
        find_subspace(bundle, [write_drive(tmp_path / "short", number, steps=30) for number in range(5)], ignore)
    always = [write_drive(tmp_path / "always", number, steps=150) for number in range(10)]
    for path in always:
        with np.load(path) as drive:
            arrays = dict(drive)
        np.savez(path, **{**arrays, "action": np.ones((150, 3), np.float32), "reward": np.ones(150, np.float32)})
    with pytest.raises(UsageError, match="10"):
        find_subspace(bundle, always, ignore)
    with pytest.raises(UsageError):
        find_subspace(bundle, drives[:4], ignore)
    with pytest.raises(DatasetError):
        find_subspace(bundle, [write_drive(tmp_path / "wide", 0, picture=96)], ignore)


def test_the_features_of_a_rounded_world_model_fit_the_whole_one_too(drives):
    assert find_subspace(find_bundle("tiny-int8"), drives, ignore).subspace.bundle == find_bundle("tiny").sha256


def test_the_verb_writes_one_and_prints_what_it_predicts(bundle, drives, folder, tmp_path, capsys):
    flags = (bundle.path, "--data", folder / "data", "--out", tmp_path / "few.npz")
    assert run_verb(verb, *flags, "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    subspace = Subspace.load(tmp_path / "few.npz")
    assert (printed["sha256"], printed["bundle"], printed["drives"]) == (subspace.sha256, bundle.sha256, 20)
    assert tuple(printed["features"]) == subspace.names
    assert len(printed["r_squared"]) == len(subspace.names)
    assert run_verb(verb, *flags) == 0
    assert "steer 0-3" in capsys.readouterr().out
    assert Subspace.load(tmp_path / "few.npz").sha256 == subspace.sha256, "equal drives make equal subspaces"
    with pytest.raises(UsageError):
        run_verb(verb, *flags, "--episodes", 4)
    with pytest.raises(UsageError, match="--views"):
        run_verb(verb, *flags, "--views", -1)
    with pytest.raises(UsageError):
        run_verb(verb, bundle.path, "--data", folder / "data", "--out", tmp_path)
    with pytest.raises(DatasetError):
        run_verb(verb, bundle.path, "--data", tmp_path / "nothing", "--out", tmp_path / "few.npz")
