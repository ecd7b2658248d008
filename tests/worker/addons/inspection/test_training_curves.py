"""Trainings by their loss curves: whole, stopped, gone back, side by side, damaged; what their VAEs keep of pictures.
Tests vae_sections.py."""

import json
import re

import numpy as np
import pygame
import pytest

from dreamfleet.common.errors import DatasetError, MissingExtraError, UsageError
from dreamfleet.worker.addons.inspection import training_curves, vae_sections, verb
from dreamfleet.worker.addons.inspection.encoded_rollout import DriveConfig
from dreamfleet.worker.addons.inspection.page_builder import write_page
from dreamfleet.worker.addons.inspection.subject import InspectionSubject
from dreamfleet.worker.addons.inspection.training_curves import UNITS, load_trainings, merge_points
from dreamfleet.worker.addons.inspection.vae_sections import VAEView, fit_picture, held_out_drive
from dreamfleet.worker.training.data.dataset import find_world, preprocessing_of_size
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.drives import train_models, write_drives
from tests.support.verbs import run_verb

LAYERS, RNN = VAEConfig(latent=4, channels=(2, 2, 4, 4)), MDNRNNConfig(latent=4, hidden=8, mixtures=2, done=True)
CONFIG = TrainConfig(updates=20, batch=4, rate=1e-3, validate_every=10)


def write(path, *points):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(point) + "\n" for point in points))
    return path.parent


def page_of(data, out, subject=None, steps=8, **more):
    return write_page(InspectionSubject(subject), out, DriveConfig(steps=steps), data, **more)


def sections(page):
    return re.findall(r'<section id="([^"]+)"', page.read_text())


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder in which both trainings are complete."""
    folder = tmp_path_factory.mktemp("plain")
    write_drives(folder, episodes=4)
    return train_models(folder, CONFIG, LAYERS, RNN)


@pytest.mark.slow
def test_a_completed_training_shows_batches_and_held_out_drives_of_every_loss(trained):
    vae, rnn = load_trainings([trained])
    assert (vae.model, list(vae.curves)) == ("vae", ["error", "kl"])
    assert (rnn.model, list(rnn.curves)) == ("mdnrnn", ["latent", "reward", "done"])
    for each, updates in (vae, [20]), (rnn, [10, 20]):
        assert each.name == trained.name
        for curve in each.curves.values():
            assert list(curve.trained.updates) == updates
            assert list(curve.held_out.updates) == [10, 20]
    assert (vae.updates, vae.best) == (20, 20)
    points = [json.loads(line) for line in (trained / "vae.jsonl").read_text().splitlines()]
    held_out = [point["held_out_error"] for point in points if "held_out_error" in point]
    np.testing.assert_array_equal(vae.curves["error"].held_out.values, held_out)


@pytest.mark.slow
def test_every_line_of_a_curve_is_in_the_chart(trained, monkeypatch):
    drawn = []
    monkeypatch.setattr(training_curves, "render_png", drawn.append)
    sections = training_curves.loss_sections(load_trainings([trained, trained]))
    assert [each.name for each in sections] == ["loss-vae", "loss-mdnrnn"]
    named = list(UNITS.values())
    for figure, parts in zip(drawn, (named[:2], named[2:]), strict=True):
        for panel, (title, unit) in zip(figure.axes, parts, strict=True):
            assert (panel.get_title(), panel.get_xlabel()) == (title, "update")
            assert panel.get_ylabel().startswith(unit)
            assert len(panel.get_lines()) == 4  # of each training batches and held-out drives
        (legend,) = figure.legends
        labels = [text.get_text() for text in legend.get_texts()]
        assert labels == [str(trained), str(trained), "batches", "held-out drives"]


def test_trainings_stand_side_by_side_each_under_its_folders_name(trained, tmp_path):
    other = write(tmp_path / "attentive" / "mdnrnn.jsonl", {"update": 10, "latent": 1.0}, {"update": 20, "latent": 0.5})
    found = load_trainings([trained, other])
    assert [(each.name, each.model) for each in found] == [
        (trained.name, "vae"), (trained.name, "mdnrnn"), ("attentive", "mdnrnn"),
    ]  # fmt: skip


def test_folders_of_one_name_are_distinguished_by_their_paths(tmp_path):
    one, other = (write(tmp_path / seed / "data" / "vae.jsonl", {"update": 1, "kl": 1.0}) for seed in "ab")
    assert [each.name for each in load_trainings([one, other])] == [str(one), str(other)]


def test_a_training_that_went_back_replaces_the_updates_after_its_checkpoint():
    before = [{"update": 10, "a": 1.0}, {"update": 10, "held_out_a": 2.0}, {"update": 20, "a": 3.0}]
    assert merge_points([*before, {"update": 10, "a": 4.0}]) == {10: {"a": 4.0}}
    assert merge_points([*before, {"update": 20, "a": 5.0}]) == {10: {"a": 1.0, "held_out_a": 2.0}, 20: {"a": 5.0}}
    assert merge_points([*before, {"update": 15, "a": 6.0}]) == {10: {"a": 1.0, "held_out_a": 2.0}, 15: {"a": 6.0}}


def test_a_curve_from_before_the_held_out_divergence_is_drawn(tmp_path):
    folder = write(
        tmp_path / "vae.jsonl", {"update": 20, "error": 9.0, "kl": 1.0},
        {"update": 20, "held_out": 11.0, "held_out_error": 8.0},
    )  # fmt: skip
    (found,) = load_trainings([folder])
    assert (found.updates, found.best) == (20, 20)
    assert not len(found.curves["kl"].held_out)
    assert training_curves.loss_sections([found])[0].picture


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "1", '{"error": 1}', '{"update": 1}', '{"update": 1, "error": NaN}', '{"update": 1, "error": "9"}',
     '{"update": 1, "error": 1e31}', '{"update": 1, "error": true}', '{"update": 1, "guessed": 2}'],
)  # fmt: skip
def test_a_damaged_curve_is_reported(tmp_path, text):
    (tmp_path / "vae.jsonl").write_text(text)
    with pytest.raises(DatasetError, match=r"vae\.jsonl"):
        load_trainings([tmp_path])


def test_a_folder_without_a_training_is_reported(tmp_path):
    for folder in (tmp_path / "tiny", tmp_path):
        with pytest.raises(DatasetError, match="--data"):
            load_trainings([folder])


@pytest.mark.slow
def test_the_verb_takes_trainings_with_a_bundle_or_without(trained, tmp_path, capsys):
    def call(*words):
        return run_verb(verb, *words, "--json", runs_dir=tmp_path)

    assert call("--data", trained, "--out", tmp_path / "one") == 0
    assert json.loads(capsys.readouterr().out)["page"] == str(tmp_path / "one" / "index.html")
    bundle = write_random_bundle(tmp_path / "b.zip", vae=LAYERS, rnn=RNN)
    assert call(bundle.path, "--data", trained, trained, "--steps", 4, "--out", tmp_path / "two") == 0
    page = (tmp_path / "two" / "index.html").read_text()
    assert 'id="loss-mdnrnn"' in page
    assert 'id="dream"' in page
    with pytest.raises(UsageError, match="--data"):
        call()


def write_picture(path, height, width):
    pygame.image.save(pygame.Surface((width, height)), path)
    return path


@pytest.mark.slow
def test_a_vae_alone_shows_what_it_keeps_of_a_held_out_drive_beside_how_it_learnt(trained, tmp_path):
    page = page_of([trained], tmp_path)
    assert sections(page) == ["reconstructions", "traversals", "latents", "samples", "loss-vae", "loss-mdnrnn"]
    assert "00000" in page.read_text()
    drive = held_out_drive(trained, VAEView.of_folder(trained), DriveConfig(steps=8))
    assert len(drive) == len(drive.mu) == 8


@pytest.mark.slow
def test_of_several_folders_each_shows_its_pictures_and_one_without_drives_its_losses_alone(trained, tmp_path):
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in ("vae.safetensors", "vae.jsonl"):
        (bare / name).write_bytes((trained / name).read_bytes())
    page = page_of([trained, trained], tmp_path / "two")
    assert sections(page) == ["reconstructions-1", "reconstructions-2", "loss-vae", "loss-mdnrnn"]
    assert sections(page_of([bare], tmp_path / "one")) == ["loss-vae"]
    (bare / "vae.safetensors").write_bytes(b"damaged")
    write_drives(bare, episodes=2)
    with pytest.raises(DatasetError):
        page_of([bare], tmp_path / "none")


@pytest.mark.slow
def test_without_torch_the_losses_are_drawn_and_the_extra_is_named(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(vae_sections, "find_spec", lambda _name: None)
    page = page_of([trained], tmp_path / "page")
    assert sections(page)[-1] == "loss-mdnrnn"
    with pytest.raises(MissingExtraError):
        page_of([trained], tmp_path, pictures=[write_picture(tmp_path / "a.png", 64, 64)])


@pytest.mark.slow
def test_own_pictures_are_looked_at_by_a_bundle_or_a_training(trained, tmp_path):
    hostile = "<b>x.png"
    sizes = {"a.jpg": (64, 64), "b.png": (96, 96), hostile: (50, 300)}
    files = [write_picture(tmp_path / name, *size) for name, size in sizes.items()]
    for subject, data in ((None, [trained]), (write_random_bundle(tmp_path / "b.zip"), [])):
        page = page_of(data, tmp_path / "page", subject, steps=4, pictures=files)
        assert sections(page)[0] == "own"
        assert hostile not in page.read_text()
    (tmp_path / "text.png").write_text("no picture")
    wrong = [([trained], [tmp_path / name]) for name in ("text.png", "nowhere.png", ".")]
    for data, pictures in (*wrong, ([trained], files * 3), ([], files)):
        with pytest.raises(UsageError):
            page_of(data, tmp_path / "page", pictures=pictures)


def test_an_observation_is_prepared_as_on_a_drive_and_any_other_picture_cut_square():
    seen = np.random.default_rng(0).integers(0, 255, (96, 96, 3), dtype=np.uint8)
    known = find_world("car-racing").preprocessings.values()
    assert np.array_equal(fit_picture(seen, 64, known), preprocessing_of_size(64).picture(seen))
    assert fit_picture(seen, 96) is seen
    wide = np.zeros((10, 30, 3), np.uint8)
    wide[:, 10:20, 0], wide[:5, :, 1] = 200, 100
    cut = fit_picture(wide, 64)
    assert cut.shape == (64, 64, 3)
    assert (cut[..., 0] == 200).all(), "its middle"
    assert cut[0, 0, 1] > cut[-1, 0, 1] == 0, "the right way up"
