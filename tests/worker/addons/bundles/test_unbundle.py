"""Checkpoints from a bundle's models, from which training resumes. Tests extract.py, weights_from_graphs.py."""

import json
from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import save

from dreamfleet.common.artifacts.bundle import DECODER, DREAM_GRAPH, ENCODER, POLICY, WEIGHTS, write_bundle
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import BundleError, DatasetError, UsageError
from dreamfleet.worker.addons.bundles.unbundle import unbundle
from dreamfleet.worker.training import train_mdnrnn
from dreamfleet.worker.training.assemble import export_graphs
from dreamfleet.worker.training.checkpoint import load_config, load_progress, load_weights
from dreamfleet.worker.training.encode import encode, encoder_hash
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel.mdnrnn_config import ATTENTIVE, MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import parts_of, write_random_bundle
from tests.support.drives import ignore, write_drives
from tests.support.models import random_models, weights

EYES = VAEConfig(latent=4, channels=(2, 3, 2, 2))
MEMORY = MDNRNNConfig(latent=4, hidden=6)


@pytest.fixture
def plain(tmp_path):
    return write_random_bundle(tmp_path / "a.zip", 3, EYES, MEMORY)


@pytest.mark.parametrize(
    ("eyes", "memory"),
    [
        *((replace(EYES, **eyes), MEMORY) for eyes in (
            {}, {"picture": 96, "padding": "same"}, {"dropout": 0.1, "activation": "leaky_relu"}, {"dense": 8},
            {"activate_dense": True},
        )),
        *((EYES, replace(MEMORY, **memory)) for memory in (
            {"done": True, "lost": 9}, {"reward": "none", "mixtures": 1}, {"joint": True, "done": True},
            {"reward": "value", "previous_reward": True, "dropout": 0.1},
        )),
        (EYES, replace(ATTENTIVE, latent=4, hidden=6, window=3, attention_units=5)),
    ],
)  # fmt: skip
def test_the_same_graphs_are_bundled_from_it_again_and_nothing_was_learnt_yet(tmp_path, eyes, memory):
    bundle = write_random_bundle(tmp_path / "a.zip", 3, eyes, memory)
    vae, rnn = unbundle(bundle, tmp_path)
    again = export_graphs(
        load_weights(vae), load_weights(rnn), np.zeros((1, 2, 4), np.float32), load_config(vae, VAEConfig),
        load_config(rnn, MDNRNNConfig),
    )  # fmt: skip
    assert all(again[name] == bundle.read(name) for name in (ENCODER, DECODER, DREAM_GRAPH, POLICY))
    assert load_progress(vae) == {"update": 0}
    assert load_progress(rnn) == {"update": 0, "vae": encoder_hash(tmp_path)}


def test_training_goes_on_from_it_also_with_a_head_more(plain, tmp_path):
    write_drives(tmp_path, episodes=3, steps=8)
    unbundle(plain, tmp_path)
    assert len(list(encode(tmp_path))) == 3
    rnn = tmp_path / train_mdnrnn.CHECKPOINT
    before = load_weights(rnn)
    few, ending = TrainConfig(updates=1, batch=2, rate=1e-9), replace(MEMORY, done=True, lost=4)
    train_mdnrnn.train_mdnrnn(tmp_path, few, ignore, ending)
    for name, values in load_weights(rnn).items():
        np.testing.assert_allclose(values[: len(before[name])], before[name], atol=1e-6)
    assert load_config(rnn, MDNRNNConfig) == ending
    with pytest.raises(DatasetError):
        train_mdnrnn.train_mdnrnn(tmp_path, replace(few, updates=2), ignore, MEMORY)


def test_weights_that_a_bundle_keeps_are_taken_as_they_were(tmp_path):
    plain = write_random_bundle(tmp_path / "a.zip", 3, replace(EYES, batch_norm=True), MEMORY)
    trained = random_models(3, replace(EYES, batch_norm=True), MEMORY)
    kept = {f"{name}.{each}": values for name, model in zip(("vae", "mdnrnn"), trained, strict=True)
            for each, values in weights(model).items()}  # fmt: skip
    parts = parts_of(plain)
    whole = write_bundle(tmp_path / "b.zip", plain.manifest, parts | {WEIGHTS: save(kept)})
    unbundle(whole, tmp_path / "kept")
    for model in ("vae", "mdnrnn"):
        for name, values in load_weights(tmp_path / "kept" / f"{model}.safetensors").items():
            assert np.array_equal(values, kept[f"{model}.{name}"])
    for wrong in (np.float32(np.nan), np.float32(1)):
        other = save({name: values + wrong if name == "vae.mu.bias" else values for name, values in kept.items()})
        lying = write_bundle(tmp_path / "c.zip", plain.manifest, parts | {WEIGHTS: other})
        with pytest.raises(BundleError):
            unbundle(lying, tmp_path / "other")


@pytest.mark.parametrize(
    ("eyes", "memory"),
    [
        (replace(EYES, batch_norm=True), MEMORY),
        (EYES, replace(MEMORY, window=2)),
        (EYES, replace(MEMORY, done=True)),
        (replace(EYES, channels=(2, 2, 2, 2)), MEMORY),
        (replace(EYES, activation="leaky_relu"), MEMORY),
        (EYES, replace(MEMORY, reward="value")),
    ],
)
def test_models_that_cannot_be_restored_are_refused(plain, tmp_path, eyes, memory):
    """The manifest of one bundle with the graphs of another."""
    other = write_random_bundle(tmp_path / "b.zip", 3, eyes, memory)
    manifest = replace(plain.manifest, models=other.manifest.models)
    with pytest.raises(BundleError):
        unbundle(write_bundle(tmp_path / "c.zip", manifest, parts_of(plain)), tmp_path / "data")
    assert not list(tmp_path.glob("data/*"))


@pytest.mark.parametrize("part", [ENCODER, DECODER, DREAM_GRAPH])
def test_a_graph_that_is_none_is_refused_in_a_line(plain, tmp_path, part):
    parts = parts_of(plain) | {part: b"\0junk" * 100}
    with pytest.raises(BundleError):
        unbundle(write_bundle(tmp_path / "b.zip", plain.manifest, parts), tmp_path / "data")


def test_where_one_of_both_cannot_be_written_neither_is(plain, tmp_path, monkeypatch):
    def full(path, *_):
        if path.name == train_mdnrnn.CHECKPOINT:
            raise DatasetError("no space left")
        path.write_bytes(b"")

    with monkeypatch.context() as patch:
        patch.setattr("dreamfleet.worker.addons.bundles.unbundle.save_checkpoint", full)
        patch.setattr("dreamfleet.worker.addons.bundles.unbundle.encoder_hash", lambda _: "")
        with pytest.raises(DatasetError):
            unbundle(plain, tmp_path / "data")
    unbundle(plain, tmp_path / "data")
    with pytest.raises(DatasetError):
        unbundle(plain, tmp_path / "a.zip")


def test_models_that_are_there_stay(plain, tmp_path, capsys):
    assert main(["bundle", "--extract", str(plain.path), "--data", str(tmp_path / "data"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["bundle"] == plain.sha256
    before = (tmp_path / "data" / "vae.safetensors").read_bytes()
    with pytest.raises(UsageError):
        unbundle(plain, tmp_path / "data")
    assert (tmp_path / "data" / "vae.safetensors").read_bytes() == before
