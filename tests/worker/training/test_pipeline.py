"""From drives to a bundle: each stage by itself, and the pipeline of all of them.

Tests dreamfleet/experiments/pipeline.py, assemble.py, encode.py, prediction_quality.py, train_mdnrnn.py,
train_vae.py, worker/training/stages/encode.py, worker/verbs/encode.py and
dreamfleet/experiments/verbs/pipeline.py.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import WEIGHTS, Bundle
from dreamfleet.common.errors import DatasetError, DreamfleetError, StoppedError, UsageError
from dreamfleet.experiments import pipeline as stages
from dreamfleet.experiments.pipeline import STAGES, check_vae
from dreamfleet.experiments.verbs import pipeline
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.assemble import assemble, load_quality, record_quality
from dreamfleet.worker.training.checkpoint import load_weights
from dreamfleet.worker.training.data.dataset import load_arrays
from dreamfleet.worker.training.encode import encode
from dreamfleet.worker.training.prediction_quality import area_under_curve
from dreamfleet.worker.training.presets import PRESETS, TrainConfig
from dreamfleet.worker.worldmodel.inference import Encoder, PolicyStep
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.drives import ignore, write_drive, write_drives
from tests.support.verbs import parse, run_verb

SHORT = TrainConfig(updates=2, batch=8, rate=1e-3)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A data folder that has been through every stage, each two updates long; read only."""
    folder = tmp_path_factory.mktemp("data")
    write_drives(folder, episodes=4, steps=6)
    train_vae.train_vae(folder, SHORT, ignore)
    assert sum(encode(folder)) == 6 + 5 + 4 + 6
    train_mdnrnn.train_mdnrnn(folder, SHORT, ignore)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("with_weights", [False, True])
def test_equal_folders_make_equal_bundles(with_weights, trained, tmp_path):
    names = [tmp_path / f"{index}.zip" for index in range(4)]
    made = [assemble(trained, each, "b", with_weights=with_weights) for each in names]
    assert len({each.sha256 for each in made}) == 1
    assert made[0].controller_shape.size == 867
    assert (WEIGHTS in made[0].manifest.parts) == with_weights


def test_a_bundle_encodes_as_its_training_did(trained, tmp_path):
    bundle = assemble(trained, tmp_path / "b.zip", "b", with_weights=True)
    pictures = load_arrays(trained / "episodes" / "000001.npz", "picture")["picture"]
    encoded = load_arrays(trained / "encoded" / "000001.npz", "mu", "mirrored_mu")
    assert np.array_equal(Encoder(bundle).encode(pictures)[0], encoded["mu"])
    mirrored = np.ascontiguousarray(pictures[:, :, ::-1])
    assert np.array_equal(Encoder(bundle).encode(mirrored)[0], encoded["mirrored_mu"])
    assert PolicyStep(bundle).shape == bundle.controller_shape


def test_the_mdnrnn_goes_on_to_the_same_weights_as_without_a_stop(trained, tmp_path):
    for name in ("encoded", train_vae.CHECKPOINT):
        (tmp_path / name).symlink_to(trained / name)
    for updates in (1, 2):
        train_mdnrnn.train_mdnrnn(tmp_path, TrainConfig(updates, 8, 1e-3), ignore)
    whole, stopped = (load_weights(each / train_mdnrnn.CHECKPOINT) for each in (trained, tmp_path))
    assert all(np.array_equal(whole[name], stopped[name]) for name in whole)


def test_latents_of_an_older_vae_never_reach_a_bundle(trained, tmp_path):
    folder = tmp_path / "data"
    shutil.copytree(trained, folder)
    train_vae.train_vae(folder, TrainConfig(3, 8, 1e-3), ignore)
    for stage in ("mdnrnn", "bundle"):
        with pytest.raises(DatasetError):
            ATTEMPTS[stage](folder)
    list(encode(folder))
    for stage in ("mdnrnn", "bundle"):
        with pytest.raises(DatasetError):
            ATTEMPTS[stage](folder)
    (folder / train_mdnrnn.CHECKPOINT).unlink()
    ATTEMPTS["mdnrnn"](folder)
    ATTEMPTS["bundle"](folder)


def test_encoding_again_encodes_only_what_is_new(tmp_path):
    write_drives(tmp_path, episodes=2, steps=4)
    train_vae.train_vae(tmp_path, TrainConfig(1, 4, 1e-3), ignore)
    assert len(list(encode(tmp_path))) == 2
    write_drive(tmp_path, 2, steps=4)
    assert list(encode(tmp_path)) == [4]


ATTEMPTS = {
    "encode": lambda folder: list(encode(folder)),
    "mdnrnn": lambda folder: train_mdnrnn.train_mdnrnn(folder, SHORT, ignore),
    "bundle": lambda folder: assemble(folder, folder / "b.zip", "b", with_weights=False),
}


@pytest.mark.parametrize("stage", ATTEMPTS)
def test_a_stage_before_its_time_names_the_verb_to_run(tmp_path, stage):
    write_drives(tmp_path, episodes=2, steps=4)
    with pytest.raises(DatasetError):
        ATTEMPTS[stage](tmp_path)


@pytest.mark.parametrize("content", [b"", b"no checkpoint", bytes(64)])
def test_a_damaged_checkpoint_is_refused_with_the_remedy(tmp_path, content):
    write_drives(tmp_path, episodes=2, steps=4)
    (tmp_path / train_vae.CHECKPOINT).write_bytes(content)
    for attempt in (
        lambda: train_vae.train_vae(tmp_path, SHORT, ignore),
        lambda: load_weights(tmp_path / train_vae.CHECKPOINT),
    ):
        with pytest.raises(DatasetError, match="--data"):
            attempt()


@pytest.mark.parametrize(
    ("scores", "positive", "area"),
    [([1, 2, 3, 4], [0, 0, 1, 1], 1.0), ([4, 3, 2, 1], [0, 0, 1, 1], 0.0), ([1, 2, 3, 4], [1, 0, 0, 1], 0.5)],
)
def test_the_area_under_the_curve(scores, positive, area):
    assert area_under_curve(np.array(scores, np.float32), np.array(positive, bool)) == area


SHARES = {"tiny": 0.004, "notebook": 0.0005, "article": 0.0002, "attentive": 0.001, "paper": 0.00002, "pixels": 0.005}
FEW = ("--jobs", "1", "--collect-flags", "--steps 24", "--vae-flags", "--batch 4", "--yes")


def call(*arguments):
    return run_verb(pipeline, *arguments)


def made(folder, preset):
    return Bundle.open(folder / f"{preset}.zip")


@pytest.mark.parametrize(
    "name",
    [pytest.param(each, marks={"tiny": (), "paper": pytest.mark.long}.get(each, pytest.mark.slow)) for each in SHARES],
)
def test_a_share_of_a_preset_becomes_a_bundle_of_its_own_layers(name, tmp_path, capsys):
    assert call("--data", tmp_path, "--preset", name, "--scale", SHARES[name], *FEW, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert tuple(answer["stages"]) == STAGES
    bundle, preset = made(tmp_path, name), PRESETS[name]
    assert answer["stages"]["bundle"]["sha256"] == bundle.sha256
    assert bundle.manifest.picture[0] == preset.collect.picture
    assert bundle.manifest.hidden == preset.mdnrnn_layers.hidden
    assert bundle.manifest.provenance["episodes"] >= 2
    assert PolicyStep(bundle).zero_state(1).shape == (1, preset.mdnrnn_layers.state)


@pytest.mark.slow
def test_it_goes_on_where_it_stopped_to_the_same_bundle(tmp_path, monkeypatch, capsys):
    flags = ("--preset", "article", "--scale", "0.0001", *FEW)
    assert call("--data", tmp_path / "whole", *flags) == 0
    assert "867" in capsys.readouterr().out

    def stop(_request, _stop):
        raise StoppedError("stopped")

    with monkeypatch.context() as patched:
        patched.setattr(stages, "encode_drives", stop)
        with pytest.raises(StoppedError):
            call("--data", tmp_path / "stopped", *flags)
    assert not (tmp_path / "stopped" / "encoded").exists()
    for _ in range(2):  # and once more, when all is finished
        assert call("--data", tmp_path / "stopped", *flags) == 0
        assert made(tmp_path / "stopped", "article").sha256 == made(tmp_path / "whole", "article").sha256


def test_nothing_is_made_on_a_vae_that_is_no_better_than_the_mean_picture(tmp_path):
    write_drives(tmp_path, episodes=4, steps=6)
    for flags in ((), ("--json",)):
        with pytest.raises(DreamfleetError) as refused:
            call("--data", tmp_path, "--preset", "tiny", "--scale", "0.001", "--jobs", 1, *flags)
        assert type(refused.value) is DreamfleetError
        assert "--yes" in str(refused.value)
    figures = load_quality(tmp_path)
    assert figures["reconstruction_error"] >= figures["mean_picture_error"]
    assert not (tmp_path / "encoded").exists()
    assert not (tmp_path / train_mdnrnn.CHECKPOINT).exists()
    record_quality(tmp_path, {"reconstruction_error": figures["mean_picture_error"] - 0.01})
    check_vae(tmp_path)


def asked(*arguments):
    return pipeline.make_request(parse(pipeline, "--data", "data", *arguments))


def test_the_world_is_of_collecting():
    found = asked("--task", "takecover", "--skip", "1", "--jobs", "2").collect
    assert (found.preset, found.task, found.world, found.jobs) == ("takecover", "takecover", {"skip": 1}, 2)


def test_each_stage_has_its_flags():
    found = asked(
        "--preset", "pixels", "--collect-flags", "--steps 7", "--vae-flags", "--set latent=5", "--mdnrnn-flags",
        "--set hidden=6 --tensorboard events", "--bundle-flags", "--reward value",
    )  # fmt: skip
    assert found.collect.settings["steps"] == 7
    assert found.vae.settings["latent"] == 5
    assert (found.mdnrnn.settings["hidden"], found.mdnrnn.tensorboard) == (6, Path("events"))
    assert (found.bundle.reward, found.bundle.out) == ("value", Path("data/pixels.zip"))
    assert "latent" not in found.mdnrnn.settings


def test_a_share_of_every_amount_is_rounded_up():
    found = asked("--preset", "notebook", "--scale", "0.02", "--seed", "3")
    assert found.collect.settings == {"episodes": 20, "seed": 3}
    assert found.vae.settings == {"updates": 600, "validate_every": 4, "seed": 3}
    assert found.mdnrnn.settings == {"updates": 200, "validate_every": 4, "seed": 3}
    least = asked("--preset", "tiny", "--scale", "1e-6")
    assert least.collect.settings["episodes"] == 2
    assert least.vae.settings["updates"] == 1


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (("--scale", "0"), "--scale.* 0"),
        (("--scale", "2"), "--scale.* 2"),
        (("--vae-flags", "--dat other"), "--vae-flags.* --data"),
        (("--collect-flags", "'"), "--collect-flags"),
        (("--bundle-flags", "--out b.zip"), "--bundle-flags.* --out"),
        (("--bundle-flags", "--end 7"), "7"),
        (("--preset", "dream"), "'dream'"),
        (("--mdnrnn-flags", "--ghost 1"), "--ghost"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_driven(tmp_path, flags, named):
    with pytest.raises(UsageError, match=named):
        call("--data", tmp_path / "data", *flags)
    assert not (tmp_path / "data").exists()


def test_another_preset_than_the_data_sets_is_refused(tmp_path):
    (tmp_path / "preset.json").write_text('{"preset": "paper"}')
    with pytest.raises(UsageError, match="--preset paper"):
        call("--data", tmp_path)


def test_a_seed_beyond_torchs_is_refused():
    with pytest.raises(UsageError, match="8796093022208"):
        TrainConfig(**{**vars(PRESETS["tiny"].vae), "seed": 10**20})


@pytest.mark.parametrize("config", [VAEConfig, MDNRNNConfig])
def test_a_size_beyond_torchs_is_refused(config):
    with pytest.raises(UsageError, match=r"16384.*18446744073709551616"):
        config(latent=2**64)
