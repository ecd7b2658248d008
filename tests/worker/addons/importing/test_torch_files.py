"""Files of `torch.save` are read as data; hostile ones are refused, and nothing in them is executed.
Also world models and controllers in the exact layout of hardmaru/WorldModelsExperiments, carracing.
Tests json_weights.py."""

import json
import os
import pickle
import struct
import zipfile

import numpy as np
import pytest
import torch

from dreamfleet.common.artifacts.bundle import INITIAL_LATENTS_PART, Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.onnx_checks import read_float_array
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.addons.importing.checkpoints import array_of, read_torch_file
from dreamfleet.worker.addons.importing.json_weights import read_mdnrnn, read_vae
from dreamfleet.worker.addons.importing.sources import PLACES
from dreamfleet.worker.worldmodel.vae_config import PAPER
from tests.support.checkpoint_files import ACTIONS, HIDDEN, LATENT, MIXTURES, sigmoid
from tests.support.wme_files import encode, vae_of, whole_numbers

LEGACY = [False, True]


def save(path, value, *, legacy=False):
    torch.save(value, path, _use_new_zipfile_serialization=not legacy)
    return path


class Calls:
    """Unpickling this would call a function."""

    def __init__(self, function, *arguments):
        self._called = function, arguments

    def __reduce__(self):
        return self._called


@pytest.mark.parametrize("legacy", LEGACY)
def test_numbers_of_torch_and_numpy(legacy, tmp_path):
    base = torch.arange(24, dtype=torch.float64).reshape(4, 6)
    values = {"state_dict": {"part": base.T[1:3]}, "reward": np.float64(3.5), "precision": np.float32(2), "epoch": 4}
    found = read_torch_file(save(tmp_path / "x.tar", values, legacy=legacy))
    assert np.array_equal(array_of(found["state_dict"]["part"], tmp_path), base.T[1:3].numpy())
    assert (found["reward"], found["precision"], found["epoch"]) == (3.5, 2, 4)


@pytest.mark.parametrize("legacy", LEGACY)
@pytest.mark.parametrize("function", [open, exec, eval, print, __import__])
def test_code_is_not_executed(function, legacy, tmp_path, capsys):
    mark = tmp_path / "executed"
    arguments = (str(mark), "w") if function is open else (f"open({str(mark)!r}, 'w')",)
    (tmp_path / "ctrl").mkdir()
    path = save(tmp_path / "ctrl" / "best.tar", {"state_dict": Calls(function, *arguments)}, legacy=legacy)
    assert main(["import", str(path), "--bundle", "tiny", "--out", str(tmp_path / "x.npz")]) == 1
    assert "best.tar" in capsys.readouterr().err
    assert not mark.exists()
    assert not (tmp_path / "x.npz").exists()


@pytest.mark.parametrize("legacy", LEGACY)
def test_a_file_cut_anywhere_is_refused(legacy, tmp_path):
    data = save(tmp_path / "x.tar", {"state_dict": {"a": torch.ones(50)}}, legacy=legacy).read_bytes()
    for length in range(0, len(data), max(1, len(data) // 60)):
        (tmp_path / "x.tar").write_bytes(data[:length])
        with pytest.raises(DatasetError):
            read_torch_file(tmp_path / "x.tar")


@pytest.mark.parametrize("legacy", LEGACY)
def test_any_changed_byte_is_refused_or_harmless(legacy, tmp_path):
    data = bytearray(save(tmp_path / "x.tar", {"state_dict": {"a": torch.ones(4)}}, legacy=legacy).read_bytes())
    random = np.random.default_rng(1)
    for place in random.integers(0, len(data), 400):
        changed = data.copy()
        changed[place] = random.integers(256)
        (tmp_path / "x.tar").write_bytes(changed)
        try:
            file = read_torch_file(tmp_path / "x.tar")
            state = file.get("state_dict") if isinstance(file, dict) else None
            tensors = state.values() if isinstance(state, dict) else ()
            assert all(array_of(each, tmp_path).size < 1000 for each in tensors if isinstance(each, torch.Tensor))
        except DatasetError:
            pass


def test_huge_tensors_are_refused_before_memory_is_taken(tmp_path):
    path = save(tmp_path / "x.tar", {"state_dict": {"a": torch.ones(77)}})
    with zipfile.ZipFile(path) as archive:
        members = {each: archive.read(each) for each in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data.replace(b"K\x4d", b"J\xff\xff\xff\x7f") if name.endswith("data.pkl") else data)
    with pytest.raises(DatasetError, match=r"x\.tar"):
        read_torch_file(path)


def test_a_tensor_that_repeats_few_numbers_often_is_refused(tmp_path):
    found = read_torch_file(save(tmp_path / "x.tar", {"a": torch.ones(1).expand(2**20, 2**19)}))
    with pytest.raises(DatasetError):
        array_of(found["a"], tmp_path)


@pytest.mark.parametrize(
    "tensor", [torch.ones(2, 2).to_sparse(), torch.empty(2, 2, device="meta"), torch.ones(2, dtype=torch.cfloat).conj()]
)
def test_tensors_that_are_no_plain_numbers_are_refused(tensor, tmp_path):
    with pytest.raises(DatasetError):
        array_of(tensor, tmp_path)


def test_a_zip_bomb_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "x.tar", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(513 << 20), compresslevel=1)
    with pytest.raises(DatasetError, match="512"):
        read_torch_file(tmp_path / "x.tar")


def test_a_legacy_file_with_a_storage_of_a_false_length_is_refused(tmp_path):
    data = save(tmp_path / "x.tar", {"a": torch.ones(4)}, legacy=True).read_bytes()
    at = data.rindex(struct.pack("<q", 4))
    for length in (2**62, -1, 2**31):
        (tmp_path / "x.tar").write_bytes(data[:at] + struct.pack("<q", length) + data[at + 8 :])
        with pytest.raises(DatasetError):
            read_torch_file(tmp_path / "x.tar")


@pytest.mark.parametrize(
    "pickled",
    [
        b"\x80\x02" + b"(" * 1000 + b".",
        b"\x80\x02X\xff\xff\xff\x7fabc",
        b"\x80\x02\x8b\xff\xff\xff\x7fabc",
        b"cos\nsystem\n(S'true'\ntR.",
        b"\x80\x02cos\nsystem\nX\x04\x00\x00\x00true\x85R.",
        b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x04true\x85R.",
        b"\x80\x02K\x01Q.",
        pickle.dumps({"state_dict": {}}, protocol=2),
        pickle.dumps(Calls(print, "hello"), protocol=0),
        b"",
    ],
)
def test_damaged_and_hostile_pickles_are_refused(pickled, tmp_path):
    (tmp_path / "x.tar").write_bytes(pickled)
    with zipfile.ZipFile(tmp_path / "y.tar", "w") as archive:
        archive.writestr("archive/data.pkl", pickled)
    for name in ("x.tar", "y.tar"):
        with pytest.raises(DatasetError, match=name):
            read_torch_file(tmp_path / name)


def test_what_is_no_checkpoint_is_refused(tmp_path, capsys):
    contents = [torch.ones(3), [1, 2], {"weights": {}}]
    contents += [{"state_dict": each} for each in (3, {"a": 1}, {1: torch.ones(2)})]
    path = tmp_path / "x.tar"
    for content in (*contents, np.ones(3)):
        if isinstance(content, np.ndarray):
            with path.open("wb") as file:
                np.savez(file, a=content)
        else:
            save(path, content)
        assert main(["import", str(path), "--bundle", "tiny", "--out", str(tmp_path / "x.npz")]) == 1
        assert "x.tar" in capsys.readouterr().err


def test_only_regular_files_of_a_bounded_size_are_read(tmp_path):
    (tmp_path / "folder.tar").mkdir()
    os.mkfifo(tmp_path / "pipe.tar")
    with (tmp_path / "large.tar").open("wb") as file:
        file.truncate((512 << 20) + 1)
    for name in ("folder.tar", "pipe.tar", "large.tar", "none.tar"):
        with pytest.raises(DatasetError, match=name):
            read_torch_file(tmp_path / name)


@pytest.fixture(scope="module")
def theirs(tmp_path_factory):
    """A folder as theirs, of random weights, and the numbers in it."""
    random = np.random.default_rng(1)
    folder = tmp_path_factory.mktemp("carracing")
    vae = vae_of(random, LATENT)
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
        latent = encode(vae, picture)
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
    weights, _ = read_mdnrnn(folder / "rnn" / "rnn.json")
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
    answer = capsys.readouterr().err
    assert all(place in answer for place in PLACES["rnn.json"])


def test_weights_that_are_not_finite_are_refused(theirs, tmp_path):
    _, vae, *_ = theirs
    text = json.dumps([each.tolist() for each in vae]).replace(str(vae[1].tolist()[0]), "1e400", 1)
    (tmp_path / "vae.json").write_text(text)
    with pytest.raises(DatasetError):
        read_vae(tmp_path / "vae.json", PAPER)
