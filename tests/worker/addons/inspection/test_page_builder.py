"""A run's page, and trainings by their loss curves: whole, stopped, gone back, side by side, damaged.
`inspect --probe` and `inspect --losses`: what they print, and the allowed drivers; how long policies live in dreams.
Tests encoded_rollout.py, mdnrnn_sections.py, measure.py, measurements.py, page.py, page_builder.py, survival.py,
training_curves.py, vae_sections.py and verb.py."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pygame
import pytest
import torch

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.common.errors import BundleError, DatasetError, MissingExtraError, UsageError
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.common.runs.records import RunSettings, StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.coordinator.jobs.evaluation import Evaluation
from dreamfleet.coordinator.jobs.scoring_job import vector_bytes
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.worker.addons.inspection import (
    dreamt_spots,
    encoded_rollout,
    mdnrnn_sections,
    measurements,
    training_curves,
    vae_sections,
    verb,
)
from dreamfleet.worker.addons.inspection.dream_comparisons import LossReport, RoadLossComparison
from dreamfleet.worker.addons.inspection.encoded_rollout import DriveConfig, record_drive
from dreamfleet.worker.addons.inspection.page import Page, Section
from dreamfleet.worker.addons.inspection.page_builder import manifest_facts, write_page
from dreamfleet.worker.addons.inspection.probe import Estimate
from dreamfleet.worker.addons.inspection.subject import DriverChoice, InspectionSubject, find_subject
from dreamfleet.worker.addons.inspection.survival import (
    PolicySurvival,
    Survival,
    SurvivalConfig,
    fixed_drivers,
    measure_survival,
)
from dreamfleet.worker.addons.inspection.training_curves import UNITS, load_trainings, merge_points
from dreamfleet.worker.addons.inspection.vae_sections import VAEView, fit_picture, held_out_drives
from dreamfleet.worker.tasks.api import World
from dreamfleet.worker.training.data.dataset import find_world, preprocessing_of_size
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel.inference import DreamStep
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle, write_world_bundle
from tests.support.drives import linked, train_models, write_drives
from tests.support.models import random_models
from tests.support.pixel_world import Dodge, DodgeTask
from tests.support.samples import SPEC
from tests.support.tables import cells
from tests.support.variants import controller_of
from tests.support.verbs import run_verb

PNG = b"\x89PNG\r\n\x1a\n"
VAE = VAEConfig(latent=5, channels=(4, 4, 4, 8))
ATTENTIVE = MDNRNNConfig(latent=5, hidden=8, mixtures=2, window=3, attention_units=4)
SHORT = DriveConfig(steps=12)
LOOKS = ["reconstructions", "spots", "traversals", "latents", "samples"]
DREAMS = ["dream", "dreamt-spots"]


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
    for name, parts in (("vae", ("error", "kl")), ("mdnrnn", ("latent", "reward"))):
        points = [{"update": update, **dict.fromkeys(parts, 100.0 / update)} for update in range(1, 60)]
        (tmp_path / f"{name}.jsonl").write_text("\n".join(json.dumps(point) for point in points))
    sections, subject = [], InspectionSubject(attentive)
    page = write_page(
        subject, tmp_path / "out", SHORT, [tmp_path], lambda done, section: sections.append((done, section.name))
    )
    found = Links(page.read_text())
    names = [*LOOKS, *DREAMS, "rewards", "attention", "loss-vae", "loss-mdnrnn"]
    assert found.sections == names
    assert sections == list(enumerate(names, 1))
    assert all(address.startswith("data:image/png;base64,") for address in found.addresses)
    assert len(found.addresses) == len(names)
    assert not found.tags & {"script", "link", "iframe", "object"}
    assert "url(" not in re.sub(r"data:[^\"]*", "", page.read_text())
    for name in names:
        assert (page.parent / f"{name}.png").read_bytes().startswith(PNG)


def test_spots_are_counted_where_they_lie_and_kept_where_the_decoder_has_them(monkeypatch):
    seen = np.random.default_rng(0).integers(20, 60, (12, 64, 64, 3), np.uint8)
    decoded, latents, drawn = seen.copy(), np.zeros((12, 5), np.float32), []
    seen[0, 5:8, 5:8] = seen[1, 50:56, 50:56] = decoded[1, 50:56, 50:56] = 240
    view = VAEView(64, 5, lambda _pictures: (latents, latents), lambda _latents: decoded)
    drive = encoded_rollout.EncodedRollout(seen, latents, latents, latents, np.zeros(12), "")
    monkeypatch.setattr(vae_sections, "render_png", drawn.append)
    vae_sections.spots(drive, view)
    fields = [(text.get_position(), text.get_text()) for each in drawn[0].axes[:2] for text in each.texts]
    assert fields == [((0, 0), "0%\nof 1"), ((3, 3), "100%\nof 1")]


@pytest.mark.slow
def test_what_a_bundle_cannot_do_is_left_out_and_a_drive_is_seen_as_it_sees(tmp_path):
    whole = VAEConfig(picture=96, padding="same", latent=5, channels=(2, 2, 2, 2))
    rnn = MDNRNNConfig(latent=5, hidden=8, reward="none")
    plain = write_random_bundle(tmp_path / "plain.zip", vae=whole, rnn=rnn)
    page = write_page(InspectionSubject(plain), tmp_path / "plain", SHORT)
    assert Links(page.read_text()).sections == [*LOOKS, *DREAMS]
    assert record_drive(plain, None, SHORT).picture.shape == (12, 96, 96, 3)


def test_the_table_has_sizes_and_quality(attentive):
    attentive.manifest.provenance.update(
        {"quality": {"reward_auc": 0.9, "kept_of_spots_5_to_16": 0.4}, "held_out_episodes": 7}
    )
    rows = dict(manifest_facts(attentive))
    assert rows["quality: reward auc"] == "0.9 (0.5 is chance, 1 exact)"
    assert rows["quality: kept of spots 5 to 16"].startswith("0.4 (")
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
    with pytest.raises(UsageError, match=f"{tmp_path.name}.*--data"), find_subject(str(tmp_path), tmp_path / "runs"):
        pass
    (tmp_path / "file").write_text("")
    for named, out, data in (("--data", "out", [tmp_path / "nowhere"]), ("--out", "file/out", [])):
        with pytest.raises(DatasetError, match=named):
            write_page(InspectionSubject(attentive), tmp_path / out, SHORT, data)


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
    assert sections(page) == ["reconstructions", "spots", "traversals", "latents", "samples", "loss-vae", "loss-mdnrnn"]
    assert "00000" in page.read_text()
    drive = next(held_out_drives(trained, VAEView.of_folder(trained), DriveConfig(steps=8)))
    assert len(drive) == len(drive.mu) == 8


@pytest.mark.slow
def test_a_folders_mdnrnn_dreams_on_from_held_out_drives_and_a_damaged_one_spoils_no_page(trained, tmp_path):
    whole = linked(trained, tmp_path / "whole", "episodes", "encoded", "vae.safetensors", "vae.jsonl")
    assert sections(page_of([trained], tmp_path, steps=12)) == [*LOOKS, "dreamt-spots", "loss-vae", "loss-mdnrnn"]
    assert (tmp_path / "dreamt-spots.png").read_bytes().startswith(PNG)
    (whole / "mdnrnn.safetensors").write_bytes(b"damaged")
    page = page_of([whole], tmp_path / "page", steps=12)
    assert sections(page) == [*LOOKS, "dreamt-spots", "loss-vae"]
    assert not (page.parent / "dreamt-spots.png").exists()


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


COMPARED = RoadLossComparison("40 steps before", 30, {"lost": {"reality": Estimate(1.0, 0.0)}})

JUDGED = 0.5  # each parameter of the run's evaluated mean


@pytest.fixture
def runs_dir(tmp_path, random_bundle):
    path = tmp_path / "runs" / "night"
    path.mkdir(parents=True)
    shape = random_bundle.controller_shape
    spec = replace(SPEC, bundle=random_bundle.sha256, temperature=1.25)
    settings = RunSettings(spec, shape, 2, 1, 0.1, "diagonal", 1, 1, 2)
    journal = Journal.create(path, settings, random_bundle.path)
    vectors = [vector_bytes(np.full(shape.size, value)) for value in (JUDGED, 1.5)]
    for number in range(3):
        journal.open_generation(number, b"", 0.1, [7], vectors)
        closed = StoredGeneration(number, number, 1.0, number + 1, 0.0, 0.1, 20, 1.0)
        journal.close_generation(closed, np.array([0.0, 1.0]))
        journal.schedule_evaluation(Evaluation(number, vectors[0], 2))
        journal.finish_evaluation(number, StoredEvaluation(number, 4, 100.0 * number, 5.0), 0)
    journal.commit()
    journal.close()
    return tmp_path / "runs"


def end(runs_dir, bundle):
    """Keep a controller of the run, which has ended: its journal says with which parameters."""
    controller_of(bundle, "dream").save(runs_dir / "night" / CONTROLLER)


@pytest.mark.slow
def test_a_run_that_goes_on_is_driven_at_random_and_one_that_has_ended_by_its_controller(
    runs_dir, random_bundle, tmp_path
):
    with find_subject("night", runs_dir) as subject:
        assert subject.controller is None
        assert 'id="fitness"' in write_page(subject, tmp_path / "out", DriveConfig(steps=4)).read_text()
    end(runs_dir, random_bundle)
    with find_subject("night", runs_dir) as subject:
        assert (subject.controller.parameters == JUDGED).all()


def test_a_bundle_is_shown_a_drive_of_another_ones_controller(random_bundle, tmp_path):
    controller, _ = find_controller("tiny", tmp_path)
    own = find_bundle("tiny")
    seen, driven = (record_drive(each, controller, DriveConfig(steps=30), own) for each in (random_bundle, own))
    assert np.array_equal(seen.action, driven.action)
    assert not np.array_equal(seen.mu, driven.mu)


def test_a_runs_own_controller_is_measured_at_the_runs_temperature(runs_dir, random_bundle, monkeypatch):
    asked = []
    report = LossReport(1, 8, 1.0, 10, (COMPARED,))
    monkeypatch.setattr(measurements, "collect_losing_drives", lambda *_given: [])
    monkeypatch.setattr(measurements, "compare_losses", lambda *given: asked.append(given) or report)
    end(runs_dir, random_bundle)
    for flags, temperature in ((), 1.25), (("--temperature", "1.5"), 1.5):
        assert run_verb(verb, "night", "--losses", *flags, runs_dir=runs_dir) == 0
        _, bundle, controller, losses, _ = asked.pop()
        assert bundle.sha256 == controller.bundle == random_bundle.sha256
        assert losses.temperature == temperature


FOUND = {"z_linear", "z_network", "zh_linear", "zh_network"}


@pytest.mark.slow
def test_likeness_prints_how_often_dreams_come_to_what_is_rare(call):
    lines = call("tiny", "--likeness", "--controller", "tiny", "--episodes", "3", "--noise", "0.1").splitlines()
    assert cells(lines[0]) == ["quantity", "rare", "reality", "reality, foreseen", "dream"]
    rows = {cells(line)[0]: cells(line)[2:] for line in lines[1:-1]}
    assert "off_road" not in rows
    assert rows["curvature_20m"][0].startswith("0.1")


@pytest.mark.slow
def test_as_json_both_have_counts_values_and_errors(call):
    found = json.loads(call("--controller", "tiny", "--probe", "--losses", "--episodes", "4", "--json"))
    assert found["bundle"] == find_bundle("tiny").sha256
    assert found["probe"]["drives"] == 4
    for known in found["probe"]["known"]:
        assert set(known["found"]) == FOUND
        assert set(known["found"]["zh_linear"]) == {"value", "error"}
    begun = {each["begun"]: each for each in found["losses"]["begun"]}
    assert {"40 steps before", "20 steps before", "0 steps before"} <= set(begun)
    assert begun["40 steps before"]["count"] == 4
    assert begun["40 steps before"]["figures"]["lost"]["reality"] == {"value": 1.0, "error": 0.0}
    assert found["losses"]["temperature"] == 1.0


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("--losses",),
        ("tiny", "--driver", "held"),
        ("tiny", "--probe"),
        ("tiny", "--probe", "--controller", "tiny", "--driver", "held"),
        ("tiny", "--probe", "--driver", "ghost"),
        ("tiny", "--losses", "--driver", "held"),
        ("tiny", "--likeness", "--driver", "held"),
        ("tiny", "--losses", "--controller", "tiny", "--episodes", "3"),
        ("tiny", "--probe", "--controller", "tiny", "--noise", "nan"),
        ("tiny", "--losses", "--controller", "tiny", "--temperature", "0"),
    ],
)
def test_what_cannot_be_measured_is_reported_before_anything_is_driven(call, arguments):
    with pytest.raises(UsageError):
        call(*arguments)


def test_a_controller_of_another_world_model_dreams_nothing(tmp_path):
    bundle, (controller, _) = find_bundle("tiny"), find_controller("tiny", tmp_path)
    other = DriverChoice(replace(controller, bundle="0" * 64), bundle)
    with pytest.raises(UsageError):
        other.dream_controller(bundle)


ENDING = MDNRNNConfig(latent=5, hidden=8, reward="none", done=True)
FACTS = DodgeTask.world.facts(RewardFacts("survival"), EndRule("drawn"))
NAMES = ["always stay", "always left", "always right", "held", "uniform"]


@pytest.fixture(scope="module")
def dodge(tmp_path_factory):
    return write_world_bundle(tmp_path_factory.mktemp("dodge") / "dodge.zip", FACTS, vae=VAE, rnn=ENDING)


@pytest.fixture
def closed(monkeypatch):
    """The environments that were closed."""
    found = []
    monkeypatch.setattr(Dodge, "close", lambda environment: found.append(environment) or None)
    return found


def test_each_choice_each_driver_and_the_controller_live_in_both(dodge, closed):
    counts = []
    found = measure_survival(dodge, controller_of(dodge, "dream"), SurvivalConfig(3, first_seed=7), counts.append)
    assert [each.policy for each in found.policies] == [*NAMES, "controller"]
    assert counts == [*range(1, 19), *range(21, 37, 3)], "episodes of six policies, then of their dreams"
    assert (found.limit, found.end, len(closed)) == (200, "drawn", 1)
    assert all(1 <= each.real.value <= 200 and 1 <= each.dreamt.value <= 200 for each in found.policies)
    assert measure_survival(dodge, None, SurvivalConfig(3, first_seed=7)).policies == found.policies[:-1]


def test_the_rule_of_ends_decides_how_long_dreams_last(dodge):
    never, at_once = (measure_survival(dodge, None, SurvivalConfig(2, end=end)) for end in ("1", "0"))
    assert {(each.dreamt.value, each.dreamt_cut) for each in never.policies} == {(200.0, 1.0)}
    assert {(each.dreamt.value, each.dreamt_cut) for each in at_once.policies} == {(1.0, 0.0)}
    assert never.end == "1.0"


def test_figures_of_known_lengths():
    lengths = [np.array([10, 30]), np.array([40, 40])]
    one = PolicySurvival.of("one", *lengths, limit=40)
    assert (one.real, one.dreamt) == (Estimate(20.0, 10.0), Estimate(40.0, 0.0))
    assert (one.ratio, one.real_cut, one.dreamt_cut) == (Estimate(2.0, 1.0), 0.0, 1.0)
    other = PolicySurvival.of("other", lengths[1], lengths[0], limit=40)
    both = Survival.of(SurvivalConfig(), 40, "0.5", (one, other)).agreement
    assert both.value == pytest.approx(-np.log(2)), "too long and too short do not make up for each other"
    assert both.error == pytest.approx(np.hypot(0.5, 0.5) / 2)
    single = PolicySurvival.of("one", lengths[0][:1], lengths[1][:1], limit=40)
    assert (single.ratio.error, Survival.of(SurvivalConfig(), 40, "0.5", (single,)).agreement.error) == (None, None)


def test_numbers_are_held_at_their_bounds():
    world = World(Continuous.between([-1, 0], [1, 4]), action_names=("turn", "push"))
    drivers = fixed_drivers(DodgeTask(), world)
    actions = {name: drivers[name](None).act().tolist() for name in drivers if name.startswith("always")}
    assert actions == {
        "always the middle": [0, 2], "always turn -1": [-1, 2], "always turn 1": [1, 2], "always push 0": [0, 0],
        "always push 4": [0, 4],
    }  # fmt: skip


def test_a_model_without_ends_and_a_stranger_are_refused(dodge, tmp_path):
    endless = write_random_bundle(tmp_path / "endless.zip", vae=VAE, rnn=MDNRNNConfig(latent=5, hidden=8))
    with pytest.raises(UsageError, match=r"endless\.zip.*--set"):
        measure_survival(endless, None, SurvivalConfig(2))
    with pytest.raises(UsageError):
        measure_survival(dodge, controller_of(endless, "dream"), SurvivalConfig(2))


def test_the_verb_prints_a_row_a_policy_or_json(dodge, call):
    lines = call(str(dodge.path), "--survival", "--episodes", "2").splitlines()
    assert cells(lines[0]) == ["policy", "reality", "dream", "dream / reality", "cut, reality", "cut, dream"]
    assert [cells(line)[0] for line in lines[1:-1]] == NAMES
    found = json.loads(call(str(dodge.path), "--survival", "--episodes", "2", "--end", "0.5", "--json"))["survival"]
    assert (found["episodes"], found["end"], found["temperature"]) == (2, "0.5", 1.0)
    assert set(found["agreement"]) == {"value", "error"}
    assert set(found["policies"][0]["ratio"]) == {"value", "error"}


@pytest.mark.slow
def test_a_page_shows_a_world_of_choices(dodge, tmp_path, closed):
    page = write_page(InspectionSubject(dodge, controller_of(dodge, "dream")), tmp_path / "page", DriveConfig(steps=12))
    assert (page.parent / "ends.png").exists()
    assert not (page.parent / "rewards.png").exists(), "it predicts none"
    assert "CarRacing" not in page.read_text()
    assert dict(manifest_facts(dodge))["task"] == DodgeTask.name
    assert len(closed) == dreamt_spots.MOST_DRIVES


def test_the_pages_drive_can_be_one_choice_by_its_number(dodge):
    driven = record_drive(dodge, None, DriveConfig(steps=4, action=(2.0,)))
    assert driven.action.tolist() == [[0, 0, 1]] * 4
    with pytest.raises(UsageError):
        record_drive(dodge, None, DriveConfig(action=(3.0,)))


def test_an_environment_is_closed_when_its_drive_fails(dodge, closed, monkeypatch):
    def fail(*_arguments):
        raise ValueError("it broke")

    monkeypatch.setattr(encoded_rollout, "run_episode", fail)
    with pytest.raises(ValueError, match="it broke"):
        record_drive(dodge, None, DriveConfig(steps=4))
    assert len(closed) == 1
