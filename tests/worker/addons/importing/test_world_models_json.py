"""World models and controllers in the exact layout of hardmaru/WorldModelsExperiments, carracing.
Tests bundles.py and json_weights.py."""

import json
from itertools import pairwise

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import INITIAL_LATENTS_PART, Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.onnx_checks import read_float_array
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.addons.importing.json_weights import read_mdnrnn, read_vae
from tests.support.checkpoint_files import ACTIONS, CHANNELS, HIDDEN, LATENT, MIXTURES, sigmoid


def whole_numbers(random, *shape, scale):
    return np.round(random.normal(0, scale, shape) * 10_000).astype(int)


@pytest.fixture(scope="module")
def theirs(tmp_path_factory):
    """A folder as theirs, of random weights, and the numbers in it."""
    random = np.random.default_rng(1)
    folder = tmp_path_factory.mktemp("carracing")
    down = [((4, 4, *channels), channels[1], (16 * channels[0]) ** -0.5) for channels in pairwise(CHANNELS)]
    up = [((5, 5, 128, 1024), 128), ((5, 5, 64, 128), 64), ((6, 6, 32, 64), 32), ((6, 6, 3, 32), 3)]
    layers = [
        *down, *[((1024, LATENT), LATENT, 1024**-0.5)] * 2, ((LATENT, 1024), 1024, 0.2),
        *((weights, biases, weights[-1] ** -0.5) for weights, biases in up),
    ]  # fmt: skip
    vae = [
        whole_numbers(random, *shape, scale=each)
        for weights, biases, scale in layers
        for shape, each in ((weights, scale), ((biases,), 0.1))
    ]
    rnn = [
        whole_numbers(random, HIDDEN, 3 * MIXTURES * LATENT, scale=0.05),
        whole_numbers(random, 3 * MIXTURES * LATENT, scale=0.1),
        whole_numbers(random, LATENT + ACTIONS + HIDDEN, 4 * HIDDEN, scale=0.08),
        whole_numbers(random, 4 * HIDDEN, scale=0.2),
    ]
    controller = random.normal(0, 0.2, ACTIONS * (LATENT + HIDDEN + 1))
    first = whole_numbers(random, 2, 7, LATENT, scale=1.0)
    for place, value in (("vae", vae), ("rnn", rnn)):
        (folder / place).mkdir()
        (folder / place / f"{place}.json").write_text(json.dumps([each.tolist() for each in value]))
    (folder / "initial_z").mkdir()
    (folder / "initial_z" / "initial_z.json").write_text(json.dumps(first.tolist()))
    (folder / "best.json").write_text(json.dumps([controller.tolist(), 905.5]))
    return folder, vae, rnn, controller


def drive_of_theirs(vae, rnn, controller, pictures):
    """Their formulas in NumPy, in double precision, on pictures as they see them, with the mean latent."""
    vae, rnn = ([each / 10_000 for each in arrays] for arrays in (vae, rnn))
    heads, _, kernel, bias = rnn
    cell, hidden, actions = np.zeros(HIDDEN), np.zeros(HIDDEN), []
    for picture in pictures:
        value = (picture - 1.0) / 255  # their pictures are CarRacing's minus 1
        for layer in range(4):
            weight, offset = vae[2 * layer], vae[2 * layer + 1]
            side = (value.shape[0] - 4) // 2 + 1
            corners = [(2 * row, 2 * column) for row in range(side) for column in range(side)]
            patches = np.stack([value[row : row + 4, column : column + 4] for row, column in corners])
            value = np.maximum(np.tensordot(patches, weight, 3) + offset, 0).reshape(side, side, -1)
        latent = value.ravel() @ vae[8] + vae[9]
        logits = np.concatenate([latent, hidden]) @ controller[3:].reshape(-1, 3) + controller[:3]
        action = np.tanh(logits)
        action = np.array([action[0], (action[1] + 1) / 2, np.clip(action[2], 0, 1)])
        gates = np.concatenate([latent, action, hidden]) @ kernel + bias
        enter, candidate, forget, leave = np.split(gates, 4)
        cell = cell * sigmoid(forget + 1) + sigmoid(enter) * np.tanh(candidate)
        hidden = np.tanh(cell) * sigmoid(leave)
        actions.append(action)
    return np.array(actions), hidden @ heads


@pytest.fixture(scope="module")
def bundle(theirs):
    path = theirs[0] / "wme.zip"
    assert main(["import", str(theirs[0]), "--out", str(path)]) == 0
    return Bundle.open(path)


@pytest.mark.slow
def test_a_controller_acts_as_in_their_program(theirs, bundle, tmp_path):
    folder, vae, rnn, vector = theirs
    out = tmp_path / "best.npz"
    assert main(["import", str(folder / "best.json"), "--bundle", str(bundle.path), "--out", str(out)]) == 0
    controller = Controller.load(out)
    pictures = np.random.default_rng(2).integers(1, 256, (20, 64, 64, 3), dtype=np.uint8)
    wanted, _ = drive_of_theirs(vae, rnn, vector, pictures)
    state, actions = None, []
    for each in pictures:
        action, state = controller.predict(each, state, bundle=bundle)
        actions.append(action)
    assert np.abs(np.array(actions) - wanted).max() < 1e-5
    assert np.ptp(wanted, axis=0).max() > 0.1  # it is not saturated


def test_heads_are_in_our_order(theirs):
    folder, _, rnn, _ = theirs
    weights = read_mdnrnn(folder / "rnn" / "rnn.json")
    latent, kind, mixture = 17, 2, 3  # theirs: 15 numbers a latent: log weights, means, log deviations
    theirs_column = latent * 3 * MIXTURES + kind * MIXTURES + mixture
    ours_row = kind * LATENT * MIXTURES + latent * MIXTURES + mixture
    assert np.allclose(weights["heads.weight"][ours_row], rnn[0][:, theirs_column] / 10_000)


def test_dreams_begin_where_theirs_do(theirs, bundle):
    found = read_float_array(bundle.read(INITIAL_LATENTS_PART))
    wanted = np.array(json.loads((theirs[0] / "initial_z" / "initial_z.json").read_text())) / 10_000
    assert found.shape == (7, 2, LATENT)
    assert np.allclose(found, wanted.swapaxes(0, 1))


@pytest.mark.parametrize(
    "content", ["", "[1, 2]", "{}", "[[1], [2], [3], [4]]", '[["a"], [2], [3], [4]]', "[" * 100_000]
)
def test_what_is_no_model_is_refused(content, tmp_path):
    (tmp_path / "rnn.json").write_text(content)
    with pytest.raises(DatasetError):
        read_mdnrnn(tmp_path / "rnn.json")


def test_a_folder_without_a_memory_is_refused(theirs, tmp_path, capsys):
    folder, *_ = theirs
    (tmp_path / "vae.json").symlink_to(folder / "vae" / "vae.json")
    assert main(["import", str(tmp_path), "--out", str(tmp_path / "x.zip")]) == 1
    assert "rnn.json" in capsys.readouterr().err


def test_weights_that_are_not_finite_are_refused(theirs, tmp_path):
    _, vae, *_ = theirs
    text = json.dumps([each.tolist() for each in vae]).replace(str(vae[1].tolist()[0]), "1e400", 1)
    (tmp_path / "vae.json").write_text(text)
    with pytest.raises(DatasetError):
        read_vae(tmp_path / "vae.json")
