"""Tests training_state.py and checkpoint.py."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from dreamfleet.common.errors import DatasetError, StoppedError, UsageError
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.assemble import assemble
from dreamfleet.worker.training.checkpoint import load_checkpoint, load_config, load_progress, load_weights
from dreamfleet.worker.training.data.rollouts import load_rollouts
from dreamfleet.worker.training.encode import encode
from dreamfleet.worker.training.presets import PRESETS, TrainConfig
from dreamfleet.worker.training.training_state import select_device, summarise_model
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN
from dreamfleet.worker.worldmodel.mdnrnn_config import ADDABLE_HEADS, MDNRNNConfig
from dreamfleet.worker.worldmodel.vae import VAE
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.drives import ignore, write_drive, write_drives

LAYERS = VAEConfig(latent=4, channels=(4, 4, 8, 8), batch_norm=True, dropout=0.1)
SMALL = MDNRNNConfig(latent=4, hidden=8, mixtures=2, dropout=0.2)
SHORT = TrainConfig(updates=4, batch=8, rate=1e-3, validate_every=2)


@pytest.fixture(scope="module")
def encoded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    write_drives(folder, episodes=4, steps=8)
    train_vae.train_vae(folder, SHORT, ignore, LAYERS)
    assert len(list(encode(folder))) == 4
    return folder


def linked(encoded, folder):
    for name in ("encoded", train_vae.CHECKPOINT):
        (folder / name).symlink_to(encoded / name)
    return folder


def equal(one: Path, other: Path):
    first, second = load_weights(one), load_weights(other)
    return all(np.array_equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("after", [1, 3])  # neither is an update after which the held-out rollouts are looked at
def test_a_stopped_training_keeps_every_update_and_resumes_to_the_same_weights(encoded, tmp_path, after):
    (tmp_path / "episodes").symlink_to(encoded / "episodes")
    made = []
    with pytest.raises(StoppedError, match=rf"{after}.*vae\.safetensors"):
        train_vae.train_vae(tmp_path, SHORT, lambda done, _: made.append(done), LAYERS, stop=lambda: made[-1] == after)
    assert load_progress(tmp_path / train_vae.CHECKPOINT)["update"] == after
    train_vae.train_vae(tmp_path, SHORT, ignore, LAYERS)
    assert equal(encoded / train_vae.CHECKPOINT, tmp_path / train_vae.CHECKPOINT)


def test_a_stopped_mdnrnn_resumes_to_the_same_weights(encoded, tmp_path):
    whole, parts = (tmp_path / name for name in ("whole", "parts"))
    for folder in (whole, parts):
        folder.mkdir()
        linked(encoded, folder)
    made = []
    train_mdnrnn.train_mdnrnn(whole, SHORT, ignore, SMALL)
    with pytest.raises(StoppedError):
        train_mdnrnn.train_mdnrnn(parts, SHORT, lambda done, _: made.append(done), SMALL, stop=lambda: made[-1] == 3)
    train_mdnrnn.train_mdnrnn(parts, SHORT, ignore, SMALL)
    assert equal(whole / train_mdnrnn.CHECKPOINT, parts / train_mdnrnn.CHECKPOINT)


def test_a_decoder_that_learns_on_leaves_latents_and_mdnrnn_as_they_are(encoded, tmp_path):
    before = load_weights(encoded / train_vae.CHECKPOINT)
    folder = tmp_path / "data"
    shutil.copytree(encoded, folder)
    train_mdnrnn.train_mdnrnn(folder, SHORT, ignore, SMALL)
    train_vae.train_vae(folder, replace(SHORT, updates=6), ignore, LAYERS, decoder_only=True)
    after = load_weights(folder / train_vae.CHECKPOINT)
    changed = {name for name in before if not np.array_equal(before[name], after[name])}
    assert changed
    assert all(name.startswith(("decoder.", "dense.")) for name in changed)
    assert list(encode(folder)) == []
    assemble(folder, tmp_path / "b.zip", "b", with_weights=False)


def test_a_decoder_alone_needs_an_encoder(encoded, tmp_path):
    (tmp_path / "episodes").symlink_to(encoded / "episodes")
    with pytest.raises(UsageError, match="--continue-from"):
        train_vae.train_vae(tmp_path, SHORT, ignore, LAYERS, decoder_only=True)
    checkpoint = encoded / train_vae.CHECKPOINT
    train_vae.train_vae(tmp_path, SHORT, ignore, LAYERS, continue_from=checkpoint, decoder_only=True)
    assert not equal(checkpoint, tmp_path / train_vae.CHECKPOINT)


def test_a_checkpoint_keeps_its_layers_and_refuses_others(encoded):
    assert load_config(encoded / train_vae.CHECKPOINT, VAEConfig) == LAYERS
    with pytest.raises(DatasetError):
        train_vae.train_vae(encoded, SHORT, ignore, replace(LAYERS, latent=5))


def test_a_done_head_can_be_added_to_a_trained_mdnrnn(encoded, tmp_path):
    """Its weights stay, to the bit; Adam's moments too, except those of extended tensors."""
    before, folder = tmp_path / "before.safetensors", tmp_path / "data"
    shutil.copytree(encoded, folder)
    checkpoint = folder / train_mdnrnn.CHECKPOINT
    checkpoint.unlink(missing_ok=True)
    train_mdnrnn.train_mdnrnn(folder, SHORT, ignore, SMALL)
    checkpoint.rename(before)
    torch.manual_seed(4)
    grown = MDNRNN(replace(SMALL, done=True, lost=3))
    optimiser = torch.optim.Adam(grown.parameters())
    own = grown.state_dict()["heads.weight"][-1].clone()
    assert load_checkpoint(before, grown, optimiser, ADDABLE_HEADS)
    for name, tensor in load_weights(before).items():
        assert np.array_equal(grown.state_dict()[name][: len(tensor)].numpy(), tensor)
    assert torch.equal(grown.state_dict()["heads.weight"][-1], own)
    shapes = [each.shape for each in grown.parameters()]
    moments = optimiser.state_dict()["state"]
    assert moments
    assert all(state["exp_avg"].shape == shapes[index] for index, state in moments.items())
    ending = replace(SMALL, done=True, lost=3)
    train_mdnrnn.train_mdnrnn(folder, SHORT, ignore, ending, continue_from=before)
    with pytest.raises(DatasetError):
        load_checkpoint(checkpoint, MDNRNN(replace(ending, lost=5)), None, ADDABLE_HEADS)
    other = checkpoint.rename(tmp_path / "ending.safetensors")
    with pytest.raises(DatasetError):
        train_mdnrnn.train_mdnrnn(folder, SHORT, ignore, SMALL, continue_from=other)


def test_a_checkpoint_that_is_cut_short_is_not_filled_up(encoded, tmp_path):
    folder = linked(encoded, tmp_path)
    train_mdnrnn.train_mdnrnn(folder, SHORT, ignore, SMALL)
    path = folder / train_mdnrnn.CHECKPOINT
    whole = load_file(path)
    with safe_open(path, "pt") as file:
        about = file.metadata()
    save_file(whole | {"model.heads.bias": whole["model.heads.bias"][:2].contiguous()}, path, about)
    with pytest.raises(DatasetError):
        load_checkpoint(path, MDNRNN(SMALL), None, ADDABLE_HEADS)


def test_training_ends_when_held_out_drives_gain_nothing_and_goes_on_with_new_ones(encoded, tmp_path):
    write_drives(tmp_path, episodes=4, steps=8)
    impatient = TrainConfig(updates=40, batch=8, rate=1e-12, patience=2, validate_every=1)
    train_vae.train_vae(tmp_path, impatient, ignore, replace(LAYERS, batch_norm=False))
    stopped = load_progress(tmp_path / train_vae.CHECKPOINT)
    assert stopped["stopped"] == 3
    assert stopped["update"] < 40
    seen = []
    train_vae.train_vae(tmp_path, impatient, lambda done, _: seen.append(done), replace(LAYERS, batch_norm=False))
    assert seen == [stopped["update"]]
    once_more = replace(impatient, patience=0, updates=stopped["update"] + 1)
    kept = (tmp_path / train_vae.CHECKPOINT).read_bytes()
    train_vae.train_vae(tmp_path, once_more, ignore, replace(LAYERS, batch_norm=False))
    assert load_progress(tmp_path / train_vae.CHECKPOINT)["update"] == stopped["update"] + 1
    (tmp_path / train_vae.CHECKPOINT).write_bytes(kept)
    write_drive(tmp_path, 4, steps=8)
    train_vae.train_vae(tmp_path, impatient, lambda done, _: seen.append(done), replace(LAYERS, batch_norm=False))
    assert len(seen) > 2


@pytest.mark.parametrize("name", PRESETS)
def test_every_presets_layers_train_and_foresee(encoded, tmp_path, name):
    layers = replace(PRESETS[name].mdnrnn_layers, latent=4, hidden=8, done=True)
    figures = train_mdnrnn.train_mdnrnn(linked(encoded, tmp_path), SHORT, ignore, layers)
    assert "nats_per_dimension" in figures
    assert any(name in figures for name in ("reward_auc", "reward_rmse")) == layers.has_reward_head


def test_training_begins_from_another_checkpoint(encoded, tmp_path):
    first, second = (tmp_path / name for name in ("first", "second"))
    for folder in (first, second):
        folder.mkdir()
        linked(encoded, folder)
    train_mdnrnn.train_mdnrnn(first, SHORT, ignore, SMALL)
    source, still = first / train_mdnrnn.CHECKPOINT, replace(SHORT, updates=2, rate=1e-12)
    train_mdnrnn.train_mdnrnn(second, still, ignore, SMALL, continue_from=source)
    one, other = load_weights(source), load_weights(second / train_mdnrnn.CHECKPOINT)
    assert all(np.allclose(one[name], other[name], atol=1e-9) for name in one)
    (second / train_mdnrnn.CHECKPOINT).unlink()
    with pytest.raises(UsageError):
        train_mdnrnn.train_mdnrnn(second, still, ignore, SMALL, continue_from=tmp_path / "absent.safetensors")


def test_a_batch_in_chunks_has_the_same_gradients(encoded, monkeypatch):
    import torch

    model = MDNRNN(replace(SMALL, dropout=0.0, done=True))
    rollouts = load_rollouts(sorted((encoded / "encoded").glob("*.npz")))
    rollouts.logvar.fill_(-100)  # chance is drawn a chunk at a time
    found = []
    for steps in (10_000, 1):
        monkeypatch.setattr("dreamfleet.worker.training.data.rollouts.CHUNK_STEPS", steps)
        model.zero_grad()
        values = train_mdnrnn.backward(model, rollouts, torch.Generator().manual_seed(0))
        found.append((values, [each.grad.clone() for each in model.parameters() if each.requires_grad]))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-5)
    for one, other in zip(found[0][1], found[1][1], strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-4)


def test_a_device_that_is_not_there_is_refused():
    assert select_device("auto").type in ("cpu", "cuda")
    with pytest.raises(UsageError):
        select_device("abacus")


def test_a_summary_counts_what_is_learnt():
    assert summarise_model(MDNRNN(PRESETS["notebook"].mdnrnn_layers)).splitlines()[-1].split()[-1] == "423,649"
    assert "BatchNorm2d" in summarise_model(VAE(LAYERS))
