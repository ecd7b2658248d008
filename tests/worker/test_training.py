import json

import numpy as np
import pytest
import torch

from common.bundle import WEIGHTS
from common.errors import DatasetError, UsageError
from worker.tasks.preprocessing import PREPROCESSING
from worker.training import assemble, checkpoint, dataset
from worker.training.collect import CollectConfig, collect, drive, episode_path
from worker.training.drivers import DRIVERS
from worker.training.encode import encode
from worker.training.presets import TrainConfig, find_preset
from worker.training.train_mdnrnn import area_under_curve, train_mdnrnn
from worker.training.train_vae import train_vae
from worker.worldmodel.inference import PolicyStep
from worker.worldmodel.mdnrnn import MDNRNN, MDNRNNConfig, latent_loss

TINY = TrainConfig(updates=4, batch=8, rate=1e-3)


def silent(_done, _note):
    pass


@pytest.fixture
def folder(tmp_path):
    """Four short drives of noise."""
    random = np.random.default_rng(0)
    (tmp_path / "episodes").mkdir()
    for number, steps in enumerate((12, 9, 15, 7)):
        np.savez_compressed(
            episode_path(tmp_path, number),
            picture=random.integers(0, 256, (steps, 64, 64, 3), dtype=np.uint8),
            action=random.uniform(0, 1, (steps, 3)).astype(np.float32),
            reward=random.choice([-0.1, 3.0], steps).astype(np.float32),
            preprocessing=np.array(PREPROCESSING),
        )
    return tmp_path


def test_an_episode_is_a_pure_function_of_seed_and_number():
    config = CollectConfig(episodes=2, steps=5)
    one, same, other = drive(config, 1), drive(config, 1), drive(config, 0)
    assert all(np.array_equal(one[name], same[name]) for name in one)
    assert not np.array_equal(one["picture"], other["picture"])
    assert one["picture"].shape == (5, 64, 64, 3)


def test_collecting_goes_on_where_it_stopped(tmp_path):
    config = CollectConfig(episodes=3, steps=3)
    assert len(list(collect(tmp_path, config, jobs=2))) == 3
    episode_path(tmp_path, 1).unlink()
    kept = episode_path(tmp_path, 0).stat().st_mtime_ns
    assert list(collect(tmp_path, config, jobs=2)) == [3]
    assert episode_path(tmp_path, 0).stat().st_mtime_ns == kept
    assert list(collect(tmp_path, config, jobs=2)) == []


@pytest.mark.parametrize("name", DRIVERS)
def test_drivers_stay_within_the_controls(name):
    driver = DRIVERS[name](np.random.default_rng(0))
    actions = np.stack([driver.act() for _ in range(2000)])
    assert (np.abs(actions[:, 0]) <= 1).all()
    assert ((actions[:, 1:] >= 0) & (actions[:, 1:] <= 1)).all()
    assert actions[:, 1].mean() > actions[:, 2].mean()


def test_the_pipeline_makes_a_bundle_that_drives(folder, tmp_path):
    assert set(train_vae(folder, TINY, silent)) == {"reconstruction_error", "mean_picture_error", "active_latents"}
    assert sum(encode(folder)) == 43
    assert list(encode(folder)) == []
    figures = train_mdnrnn(folder, TINY, silent)
    assemble.record_quality(folder, figures)
    bundle = assemble.assemble(folder, tmp_path / "b.zip", "b", with_weights=True)
    assert bundle.manifest.provenance["quality"] == pytest.approx(figures, nan_ok=True)
    assert WEIGHTS in bundle.manifest.parts
    policy = PolicyStep(bundle)
    picture, parameters = np.zeros((1, 64, 64, 3), np.uint8), np.zeros((1, 867), np.float32)
    assert np.isfinite(policy.step(picture, parameters, *policy.zero_state(1)).hidden).all()


def test_training_goes_on_from_a_checkpoint_and_ends_when_it_has_enough(folder):
    told = []
    train_vae(folder, TINY, lambda done, _note: told.append(done))
    assert told == [0, 1, 2, 3, 4]
    told.clear()
    train_vae(folder, TrainConfig(updates=6, batch=8, rate=1e-3), lambda done, _note: told.append(done))
    assert told == [4, 5, 6]
    lines = (folder / "vae.jsonl").read_text().splitlines() if (folder / "vae.jsonl").exists() else []
    assert all(json.loads(line)["update"] % 20 == 0 for line in lines)


def test_padding_does_not_count():
    torch.manual_seed(0)
    model = MDNRNN(MDNRNNConfig(latent=2, hidden=8))
    inputs, targets, mask = torch.randn(1, 6, 5), torch.randn(1, 6, 2), torch.ones(1, 6)
    mask[:, 4:] = 0
    before = latent_loss(model(inputs), targets, mask)
    targets[:, 4:] = 1e3
    assert torch.equal(latent_loss(model(inputs), targets, mask), before)


def test_a_data_set_that_is_empty_or_damaged_is_one_clear_line(folder, tmp_path):
    with pytest.raises(DatasetError, match=r"holds 0 episodes; .*dreamfleet collect"):
        dataset.episodes(tmp_path / "absent")
    with pytest.raises(DatasetError, match="run `dreamfleet train vae"):
        list(encode(folder))
    episode_path(folder, 2).write_bytes(b"half an epis")
    with pytest.raises(DatasetError, match=r"000002.npz is damaged"):
        train_vae(folder, TINY, silent)


def test_pictures_of_another_preprocessing_are_refused(folder):
    np.savez(episode_path(folder, 0), picture=np.zeros((3, 32, 32, 3), np.uint8), preprocessing=np.array("other"))
    with pytest.raises(DatasetError, match="another preprocessing"):
        dataset.load_pictures(episode_path(folder, 0))


def test_a_damaged_checkpoint_is_not_taken_for_none(folder):
    (folder / "vae.safetensors").write_bytes(b"no tensors")
    with pytest.raises(DatasetError, match="delete it to begin anew"):
        train_vae(folder, TINY, silent)
    with pytest.raises(DatasetError, match="train it first"):
        checkpoint.load_weights(folder / "mdnrnn.safetensors")


def test_the_area_under_the_curve():
    scores = np.array([0.1, 0.4, 0.35, 0.8], np.float32)
    assert area_under_curve(scores, np.array([False, False, True, True])) == 0.75
    assert np.isnan(area_under_curve(scores, np.zeros(4, bool)))


def test_an_unknown_preset_names_the_known_ones():
    with pytest.raises(UsageError, match="unknown preset 'huge': choose one of tiny"):
        find_preset("huge")
