"""Tests page_builder.py, encoded_rollout.py, mdnrnn_sections.py and page.py."""

import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
import torch

from dreamfleet.common.errors import BundleError, DatasetError, UsageError
from dreamfleet.worker.addons.inspection import mdnrnn_sections
from dreamfleet.worker.addons.inspection.encoded_rollout import DriveConfig, record_drive
from dreamfleet.worker.addons.inspection.page import Page, Section
from dreamfleet.worker.addons.inspection.page_builder import manifest_facts, write_page
from dreamfleet.worker.addons.inspection.subject import InspectionSubject, find_subject
from dreamfleet.worker.worldmodel.inference import DreamStep
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.models import random_models

PNG = b"\x89PNG\r\n\x1a\n"
VAE = VAEConfig(latent=5, channels=(4, 4, 4, 8))
ATTENTIVE = MDNRNNConfig(latent=5, hidden=8, mixtures=2, window=3, attention_units=4)
SHORT = DriveConfig(steps=12)
LOOKS = ["reconstructions", "traversals", "latents", "samples"]


class Links(HTMLParser):
    """Collects the tags, the addresses that a browser would fetch, and the ids of the sections."""

    def __init__(self, text):
        super().__init__()
        self.addresses, self.sections, self.tags = [], [], set()
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        self.addresses += [value for name, value in attributes if name in ("src", "href", "srcset", "data", "action")]
        self.sections += [dict(attributes)["id"]] if tag == "section" else []


def write_curves(folder):
    for name, parts in (("vae", ("error", "kl")), ("mdnrnn", ("latent", "reward"))):
        points = [{"update": update, **dict.fromkeys(parts, 100.0 / update)} for update in range(1, 60)]
        (folder / f"{name}.jsonl").write_text("\n".join(json.dumps(point) for point in points))


@pytest.fixture
def attentive(tmp_path):
    return write_random_bundle(tmp_path / "attentive.zip", vae=VAE, rnn=ATTENTIVE)


def test_the_pages_drive_can_be_one_action_alone(attentive):
    driven = record_drive(attentive, None, DriveConfig(steps=12, action=(-0.01, 1.0, 0.0)))
    assert driven.action.tolist() == [np.array((-0.01, 1, 0), np.float32).tolist()] * 12
    assert driven.description.endswith("-0.01 1 0")
    for wrong in ((1.0,), (0.0, 2.0, 0.0), (0.0, float("nan"), 0.0), (0.0, 1e40, 0.0)):
        with pytest.raises(UsageError):
            record_drive(attentive, None, DriveConfig(action=wrong))


@pytest.mark.slow
def test_a_page_has_every_section_and_needs_nothing_else(attentive, tmp_path):
    write_curves(tmp_path)
    sections, subject = [], InspectionSubject(attentive)
    page = write_page(subject, tmp_path / "out", SHORT, [tmp_path], lambda *done: sections.append(done))
    found = Links(page.read_text())
    names = [*LOOKS, "dream", "rewards", "attention", "loss-vae", "loss-mdnrnn"]
    assert found.sections == names
    assert sections == list(enumerate(names, 1))
    assert all(address.startswith("data:image/png;base64,") for address in found.addresses)
    assert len(found.addresses) == len(names)
    assert not found.tags & {"script", "link", "iframe", "object"}
    assert "url(" not in re.sub(r"data:[^\"]*", "", page.read_text())
    for name in names:
        assert (page.parent / f"{name}.png").read_bytes().startswith(PNG)


@pytest.mark.slow
def test_what_a_bundle_cannot_do_is_left_out_and_a_drive_is_seen_as_it_sees(tmp_path):
    whole = VAEConfig(picture=96, padding="same", latent=5, channels=(2, 2, 2, 2))
    rnn = MDNRNNConfig(latent=5, hidden=8, reward="none")
    plain = write_random_bundle(tmp_path / "plain.zip", vae=whole, rnn=rnn)
    page = write_page(InspectionSubject(plain), tmp_path / "plain", SHORT)
    assert Links(page.read_text()).sections == [*LOOKS, "dream"]
    assert record_drive(plain, None, SHORT).picture.shape == (12, 96, 96, 3)


def test_the_table_has_sizes_and_quality(attentive):
    attentive.manifest.provenance.update({"quality": {"reward_auc": 0.9}, "held_out_episodes": 7})
    rows = dict(manifest_facts(attentive))
    assert rows["quality: reward auc"] == "0.9 (0.5 is chance, 1 exact)"
    assert (rows["latents"], rows["attention window"], rows["held out episodes"]) == ("5", "3", "7")


def test_a_page_escapes_what_a_stranger_named():
    page = Page("<b>", "&", [("<i>", "<script>")], [Section('a"b', "<h>", "<p>")]).html()
    assert Links(page).tags <= {"html", "head", "meta", "title", "style", "body", "h1", "p", "table", "tr", "th", "td",
                                "section", "h2"}  # fmt: skip


def test_a_drive_is_a_function_of_its_seed(attentive):
    one, other = (record_drive(attentive, None, SHORT) for _ in range(2))
    assert len(one) == SHORT.steps
    assert np.array_equal(one.picture, other.picture)
    assert not np.array_equal(one.picture, record_drive(attentive, None, DriveConfig(20_001, 12)).picture)
    assert list(one.nats[one.most_active]) == sorted(one.nats, reverse=True)


def test_dreams_begin_at_the_drives_first_latent_and_take_its_actions(attentive):
    driven = record_drive(attentive, None, SHORT)
    dreamt = mdnrnn_sections.dream_latents(attentive, driven, 1.0)
    assert dreamt.shape == driven.mu.shape
    assert np.array_equal(dreamt[0], driven.mu[0])
    assert not np.array_equal(dreamt[1], mdnrnn_sections.dream_latents(attentive, driven, 1.0, seed=1)[1])
    driven.action[:] = driven.action[::-1].copy()
    assert not np.array_equal(dreamt, mdnrnn_sections.dream_latents(attentive, driven, 1.0))


def test_attention_is_that_of_the_trained_model(attentive):
    _, model = random_models(0, VAE, ATTENTIVE)
    random = np.random.default_rng(1)
    latent, action = random.normal(size=(2, 5)).astype(np.float32), random.normal(size=(2, 3)).astype(np.float32)
    state = random.normal(size=(2, ATTENTIVE.state)).astype(np.float32)
    window = np.concatenate([state[:, 2 * 8 + 8 :], latent, action], axis=1).reshape(2, 3, 8)
    with torch.no_grad():
        query = model.query(torch.from_numpy(state[:, :8]))[:, None]
        expected = torch.softmax(model.score(torch.tanh(model.keys(torch.from_numpy(window)) + query)), dim=1)[..., 0]
    np.testing.assert_allclose(DreamStep(attentive).attend(latent, action, state), expected.numpy(), atol=1e-6)


def test_what_is_missing_is_reported_before_anything_is_driven(tmp_path, attentive):
    with pytest.raises(BundleError, match=r"'nosuch'.*'nosuch'"), find_subject("nosuch", tmp_path):
        pass
    (tmp_path / "file").write_text("")
    for named, out, data in (("--data", "out", [tmp_path / "nowhere"]), ("--out", "file/out", [])):
        with pytest.raises(DatasetError, match=named):
            write_page(InspectionSubject(attentive), tmp_path / out, SHORT, data)
