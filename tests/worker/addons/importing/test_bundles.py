"""World models and controllers in the exact layout of hardmaru/WorldModelsExperiments, doomrnn.
Tests bundles.py and json_weights.py."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import INITIAL_LATENTS_PART, Bundle
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.onnx_checks import read_float_array
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.addons.importing.json_weights import read_initial_latents, read_mdnrnn
from dreamfleet.worker.addons.importing.sources import PLACES, find_json, refuse_unreadable
from dreamfleet.worker.tasks.registry import find_world
from dreamfleet.worker.worldmodel.inference import DreamStep
from tests.support.checkpoint_files import sigmoid
from tests.support.doom import use_fake
from tests.support.wme_files import LATENT, MIXTURES, UNITS, Memory, drive, write_doomrnn

BEST = "log/doomrnn.cma.16.64.best.json"


@pytest.fixture(scope="module")
def theirs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wme") / "doomrnn"
    return folder, *write_doomrnn(folder)


@pytest.fixture(scope="module")
def bundle(theirs):
    path = theirs[0].parent / "doom.zip"
    assert main(["import", str(theirs[0]), "--out", str(path)]) == 0
    return Bundle.open(path)


def test_the_world_is_as_there(theirs, bundle):
    facts = bundle.manifest.world
    assert (facts.horizon, facts.frames_per_second) == (2100, 35)  # a decision a tic
    assert (facts.actions.outputs, facts.low, facts.high) == (1, (-1.0,), (1.0,))
    assert (facts.reward, facts.end.at, facts.end.kind) == (RewardFacts("survival", 1.0), 0.5, EndRule().kind)
    pictures = find_world(bundle.manifest.task, facts.options).preprocessings[bundle.manifest.preprocessing]
    seen = pictures.picture(np.arange(120, dtype=np.uint8)[:, None, None].repeat(160, 1).repeat(3, 2))
    assert 10 <= seen.min() <= 11  # rows 10 to 109 of 120
    assert 108 <= seen.max() <= 109
    wanted = np.array(json.loads((theirs[0] / "tf_models" / "initial_z.json").read_text())) / 10_000
    assert np.allclose(read_float_array(bundle.read(INITIAL_LATENTS_PART)), wanted.swapaxes(0, 1))


@pytest.mark.slow
def test_a_controller_acts_as_in_their_program(theirs, bundle, tmp_path):
    folder, vae, rnn, vector = theirs
    out = tmp_path / "best.npz"
    assert main(["import", str(folder / BEST), "--bundle", str(bundle.path), "--out", str(out)]) == 0
    controller = Controller.load(out)
    pictures = np.random.default_rng(2).integers(1, 256, (20, 64, 64, 3), dtype=np.uint8)
    wanted = drive(vae, rnn, vector, pictures)
    state, actions = None, []
    for each in pictures:
        action, state = controller.predict(each, state, bundle=bundle)
        actions.append(action[0])
    assert np.abs(np.array(actions) - wanted).max() < 1e-5
    assert np.ptp(wanted) > 0.1  # it is not saturated
    assert np.abs(wanted).max() < 0.99


def test_evaluate_plays_a_controller_in_the_game(theirs, bundle, tmp_path, monkeypatch):
    use_fake(monkeypatch)
    out, report = tmp_path / "best.npz", tmp_path / "report.json"
    assert main(["import", str(theirs[0] / BEST), "--bundle", str(bundle.path), "--out", str(out)]) == 0
    words = ["--controller", str(out), "--bundle", str(bundle.path), "--episodes", "1", "--jobs", "1"]
    assert main(["evaluate", *words, "--out", str(report)]) == 0
    assert json.loads(report.read_text())["drives"][0]["score"] >= 40  # the stand-in's shortest game


def test_dreams_are_theirs_and_the_first_step_is_another(theirs, bundle):
    step, random, memory = DreamStep(bundle), np.random.default_rng(4), Memory(theirs[2])
    state, ends = step.zero_state(1), []
    for _ in range(4):
        latent, action = random.normal(0, 1, LATENT), random.uniform(-1, 1)
        uniform, normal = random.random((2, 1, LATENT), dtype=np.float32)
        seen = latent[None].astype(np.float32), np.array([[action]], np.float32)
        found = step.imagine(*seen, state, uniform, normal, 1.0)
        logits, means, spreads, end = memory.advance(latent, action)
        weights = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
        chosen = (np.cumsum(weights, axis=1) < uniform[0][:, None]).sum(axis=1)
        rows = np.arange(LATENT)
        wanted = means[rows, chosen] + np.exp(spreads[rows, chosen]) * normal[0]
        near = np.abs(np.cumsum(weights, axis=1) - uniform[0][:, None]).min(axis=1) < 1e-3  # of two mixtures
        assert np.abs(found.latent[0] - wanted)[~near].max() < 5e-3  # heads have half precision
        assert found.done[0] == pytest.approx(sigmoid(end), abs=5e-3)
        state, ends = found.state, [*ends, sigmoid(end)]
    assert np.allclose(state[0, :UNITS], memory.hidden, atol=1e-5)
    assert np.allclose(state[0, UNITS + 1 : -1], memory.cell, atol=1e-5)
    assert np.ptp(ends) > 0.01


def test_the_input_of_the_first_step_counts_once(theirs):
    """Without that input the second step of our LSTM would be as the first."""
    weights, layers = read_mdnrnn(theirs[0] / "tf_models" / "rnn.json")
    first = theirs[2][0][LATENT + 1, :UNITS] / 10_000  # of the input gates, which come first in both
    assert layers.mixtures == MIXTURES
    assert np.allclose(weights["lstm.weight_hh_l0"][:UNITS, -1] * np.tanh(1), -first, atol=1e-6)


@pytest.mark.parametrize("size", [LATENT + UNITS, LATENT + 2 * UNITS + 1, LATENT + 2 * UNITS + 3])
def test_a_controller_of_another_size_is_refused(size, bundle, tmp_path, capsys):
    (tmp_path / "v.json").write_text(json.dumps([[0.0] * size, 1.0]))
    out = tmp_path / "x.npz"
    assert main(["import", str(tmp_path / "v.json"), "--bundle", str(bundle.path), "--out", str(out)]) == 1
    assert str(LATENT + 2 * UNITS) in capsys.readouterr().err
    assert not out.exists()


def test_our_own_vectors_of_such_a_bundle_lie_as_always(bundle, tmp_path):
    vector, out = np.arange(bundle.controller_shape.size, dtype=np.float32), tmp_path / "x.npz"
    np.save(tmp_path / "v.npy", vector)
    assert main(["import", str(tmp_path / "v.npy"), "--bundle", str(bundle.path), "--out", str(out)]) == 0
    assert np.array_equal(Controller.load(out).parameters, vector)
    assert find_bundle(str(bundle.path)).manifest.hidden == 2 * (UNITS + 1)


@pytest.mark.parametrize("number", ["3e42", "7e8", "1e300", "1e999", "NaN", "null", "true", '"12"', "{}"])
def test_what_is_no_weight_is_refused(number, tmp_path):
    text = json.dumps([np.zeros(shape, int).tolist() for shape in ((578, 2048), (2048,), (512, 961), (961,))])
    (tmp_path / "rnn.json").write_text(text.replace("0", number, 1))
    with pytest.raises(DatasetError, match=r"rnn\.json"):
        read_mdnrnn(tmp_path / "rnn.json")


def test_one_that_is_refused_replaces_no_bundle(theirs, tmp_path, capsys):
    """Its numbers are finite in single precision, and their sums are not."""
    arrays, path, folder = [each.tolist() for each in theirs[2]], tmp_path / "doom.zip", tmp_path / "tf_models"
    arrays[0][LATENT + 1] = [3e42] * 4 * UNITS
    folder.mkdir()
    (folder / "rnn.json").write_text(json.dumps(arrays))
    (folder / "vae.json").symlink_to(theirs[0] / "tf_models" / "vae.json")
    path.write_bytes(b"another")
    assert main(["import", str(folder), "--out", str(path)]) == 1
    assert "rnn.json" in capsys.readouterr().err
    assert path.read_bytes() == b"another"


@pytest.mark.parametrize("logvar", ["1e7", "true", '"12"', "NaN"])
def test_first_latents_without_a_spread_are_refused(logvar, tmp_path):
    (tmp_path / "initial_z.json").write_text(f"[[[1, 2]], [[3, {logvar}]]]")
    with pytest.raises(DatasetError, match="initial_z"):
        read_initial_latents(tmp_path / "initial_z.json", 2)


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo, lambda path: path.symlink_to("nowhere")])
def test_first_latents_that_cannot_be_read_are_not_left_out(make, tmp_path):
    make(tmp_path / "initial_z.json")
    with pytest.raises(DatasetError, match="initial_z"):
        read_initial_latents(find_json(tmp_path, "initial_z.json"), LATENT)


@pytest.mark.parametrize("name", PLACES)
def test_a_file_of_a_folder_alone_is_not_read(name, tmp_path):
    (tmp_path / name).write_text("[]")
    with pytest.raises(DatasetError, match=name):
        refuse_unreadable(tmp_path / name)


def test_doom_s_layers_of_another_size_are_refused(theirs, tmp_path, capsys):
    arrays = json.loads((theirs[0] / "tf_models" / "rnn.json").read_text())
    arrays[3].append(0)
    (tmp_path / "rnn.json").write_text(json.dumps(arrays))
    (tmp_path / "vae.json").write_text("[]")
    assert main(["import", str(tmp_path), "--out", str(tmp_path / "x.zip")]) == 1
    assert "rnn.json" in capsys.readouterr().err
