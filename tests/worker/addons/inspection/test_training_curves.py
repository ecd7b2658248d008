"""Trainings loaded from their loss curves: whole, stopped, gone back, side by side, damaged.
Tests curve_sections.py."""

import json

import numpy as np
import pytest

from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.worker.addons.inspection import curve_sections, verb
from dreamfleet.worker.addons.inspection.encoded_rollout import DriveConfig
from dreamfleet.worker.addons.inspection.page_builder import InspectionSubject, write_page
from dreamfleet.worker.addons.inspection.training_curves import UNITS, load_trainings, merge_points
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.encode import encode
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.drives import ignore, write_drives
from tests.support.verbs import run_verb

LAYERS, RNN = VAEConfig(latent=4, channels=(2, 2, 4, 4)), MDNRNNConfig(latent=4, hidden=8, mixtures=2, done=True)
CONFIG = TrainConfig(updates=20, batch=4, rate=1e-3, validate_every=10)


def write(path, *points):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(point) + "\n" for point in points))
    return path.parent


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder in which both trainings are complete."""
    folder = tmp_path_factory.mktemp("plain")
    write_drives(folder, episodes=4, steps=6)
    train_vae.train_vae(folder, CONFIG, ignore, LAYERS)
    assert len(list(encode(folder))) == 4
    train_mdnrnn.train_mdnrnn(folder, CONFIG, ignore, RNN)
    return folder


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
    assert [each.name for each in curve_sections.loss_sections([vae, rnn])] == ["loss-vae", "loss-mdnrnn"]


@pytest.mark.slow
def test_every_line_of_a_curve_is_in_the_chart(trained, monkeypatch):
    drawn = []
    monkeypatch.setattr(curve_sections, "render_png", drawn.append)
    curve_sections.loss_sections(load_trainings([trained, trained]))
    named = list(UNITS.values())
    for figure, parts in zip(drawn, (named[:2], named[2:]), strict=True):
        panels = figure.axes
        assert [panel.get_title() for panel in panels] == [title for title, _ in parts]
        assert all(panel.get_ylabel().startswith(unit) for panel, (_, unit) in zip(panels, parts, strict=True))
        assert all(len(panel.get_lines()) == 4 for panel in panels)  # of each training batches and held-out drives
        assert {panel.get_xlabel() for panel in panels} == {"update"}
        (legend,) = figure.legends
        labels = [text.get_text() for text in legend.get_texts()]
        assert labels == [str(trained), str(trained), "batches", "held-out drives"]


@pytest.mark.slow
def test_trainings_stand_side_by_side_each_under_its_folders_name(trained, tmp_path):
    other = write(tmp_path / "attentive" / "mdnrnn.jsonl", {"update": 10, "latent": 1.0}, {"update": 20, "latent": 0.5})
    found = load_trainings([trained, other])
    assert [(each.name, each.model) for each in found] == [
        (trained.name, "vae"), (trained.name, "mdnrnn"), ("attentive", "mdnrnn"),
    ]  # fmt: skip
    page = write_page(InspectionSubject(None), tmp_path / "out", DriveConfig(), [trained, other]).read_text()
    assert f"{trained.name}, attentive" in page
    assert "attentive, the MDN-RNN</th>" in page
    assert sorted(each.name for each in (tmp_path / "out").iterdir()) == [
        "index.html",
        "latents.png",
        "loss-mdnrnn.png",
        "loss-vae.png",
        "reconstructions.png",
        "samples.png",
        "traversals.png",
    ]


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
    assert curve_sections.loss_sections([found])[0].picture


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
    with pytest.raises(DatasetError, match="--data"):
        load_trainings([tmp_path / "tiny"])
    with pytest.raises(DatasetError, match="--data"):
        load_trainings([tmp_path])


@pytest.mark.slow
def test_the_verb_takes_trainings_with_a_bundle_or_without(trained, tmp_path, capsys):
    def call(*words):
        return run_verb(verb, *words, "--json", runs_dir=tmp_path)

    assert call("--data", trained, "--out", tmp_path / "one") == 0
    assert json.loads(capsys.readouterr().out)["page"] == str(tmp_path / "one" / "index.html")
    bundle = write_random_bundle(
        tmp_path / "b.zip", vae=VAEConfig(latent=5, channels=(4, 4, 4, 8)), rnn=MDNRNNConfig(5)
    )
    flags = ("--steps", 4, "--out", tmp_path / "two")
    assert call(bundle.path, "--data", trained, trained, *flags) == 0
    page = (tmp_path / "two" / "index.html").read_text()
    assert 'id="loss-mdnrnn"' in page
    assert 'id="dream"' in page
    with pytest.raises(UsageError, match="--data"):
        call()


@pytest.mark.slow
def test_held_out_losses_lie_where_they_were_looked_at(trained):
    points = [json.loads(line) for line in (trained / "vae.jsonl").read_text().splitlines()]
    held = {point["update"]: point["held_out_error"] for point in points if "held_out_error" in point}
    line = load_trainings([trained])[0].curves["error"].held_out
    np.testing.assert_array_equal(line.values, list(held.values()))
