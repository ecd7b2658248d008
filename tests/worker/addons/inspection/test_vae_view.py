"""Pages of a VAE without an MDN-RNN or a bundle, and of the user's own pictures. Tests vae_sections.py."""

import re

import numpy as np
import pygame
import pytest

from dreamfleet.common.errors import DatasetError, MissingExtraError, UsageError
from dreamfleet.worker.addons.inspection import vae_view as module
from dreamfleet.worker.addons.inspection.encoded_rollout import DriveConfig
from dreamfleet.worker.addons.inspection.page_builder import InspectionSubject, write_page
from dreamfleet.worker.addons.inspection.vae_sections import fit_picture
from dreamfleet.worker.addons.inspection.vae_view import VAEView, held_out_drive
from dreamfleet.worker.training import train_vae
from dreamfleet.worker.training.data.dataset import find_world, preprocessing_of_size
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.drives import write_drives

LAYERS = VAEConfig(latent=4, channels=(2, 2, 4, 4))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A data set on which a VAE was trained, and nothing else."""
    made = tmp_path_factory.mktemp("vae")
    write_drives(made, episodes=4, steps=12)
    train_vae.train_vae(made, TrainConfig(updates=20, batch=4, rate=1e-3, validate_every=10), lambda *_: None, LAYERS)
    return made


def write_picture(path, height, width):
    pygame.image.save(pygame.Surface((width, height)), path)
    return path


def sections(page):
    return re.findall(r'<section id="([^"]+)"', page.read_text())


@pytest.mark.slow
def test_a_vae_alone_shows_what_it_keeps_of_a_held_out_drive_beside_how_it_learnt(folder, tmp_path):
    page = write_page(InspectionSubject(None), tmp_path, DriveConfig(steps=8), [folder])
    assert sections(page) == ["reconstructions", "traversals", "latents", "samples", "loss-vae"]
    assert "00000" in page.read_text()
    drive = held_out_drive(folder, VAEView.of_folder(folder), DriveConfig(steps=8))
    assert len(drive) == len(drive.mu) == 8


@pytest.mark.slow
def test_of_several_folders_each_shows_its_pictures_and_one_without_drives_its_losses_alone(folder, tmp_path):
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in ("vae.safetensors", "vae.jsonl"):
        (bare / name).write_bytes((folder / name).read_bytes())
    page = write_page(InspectionSubject(None), tmp_path / "two", DriveConfig(), [folder, folder])
    assert sections(page) == ["reconstructions-1", "reconstructions-2", "loss-vae"]
    assert sections(write_page(InspectionSubject(None), tmp_path / "one", DriveConfig(), [bare])) == ["loss-vae"]
    (bare / "vae.safetensors").write_bytes(b"damaged")
    write_drives(bare, episodes=2)
    with pytest.raises(DatasetError):
        write_page(InspectionSubject(None), tmp_path / "none", DriveConfig(), [bare])


@pytest.mark.slow
def test_without_torch_the_losses_are_drawn_and_the_extra_is_named(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda _name: None)
    page = write_page(InspectionSubject(None), tmp_path / "page", DriveConfig(), [folder])
    assert sections(page)[-1] == "loss-vae"
    with pytest.raises(MissingExtraError):
        write_page(
            InspectionSubject(None),
            tmp_path,
            DriveConfig(),
            [folder],
            pictures=[write_picture(tmp_path / "a.png", 64, 64)],
        )


@pytest.mark.slow
def test_own_pictures_are_looked_at_by_a_bundle_or_a_training(folder, tmp_path):
    hostile = "<b>x.png"
    files = [write_picture(tmp_path / name, *size)
             for name, size in (("a.jpg", (64, 64)), ("b.png", (96, 96)), (hostile, (50, 300)))]  # fmt: skip
    bundle = write_random_bundle(tmp_path / "b.zip")
    for subject, data in ((InspectionSubject(None), [folder]), (InspectionSubject(bundle), [])):
        page = write_page(subject, tmp_path / "page", DriveConfig(steps=4), data, pictures=files)
        assert sections(page)[0] == "own"
        assert hostile not in page.read_text()
    (tmp_path / "text.png").write_text("no picture")
    for wrong in ("text.png", "nowhere.png", "."):
        with pytest.raises(UsageError):
            write_page(InspectionSubject(None), tmp_path / "page", DriveConfig(), [folder], pictures=[tmp_path / wrong])
    with pytest.raises(UsageError):
        write_page(InspectionSubject(None), tmp_path / "page", DriveConfig(), [folder], pictures=files * 3)
    with pytest.raises(UsageError):
        write_page(InspectionSubject(None), tmp_path / "page", DriveConfig(), pictures=files)


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
