"""Malformed bundles and data sets are refused in one line before anything runs.
Tests common/artifacts/onnx_checks.py."""

import re
import shutil
from dataclasses import replace

import numpy as np
import onnx
import pytest

from dreamfleet.common.artifacts.bundle import DREAM_GRAPH, INITIAL_LATENTS_PART, POLICY, RECORDED_STATES, write_bundle
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.car_racing_variants import FACTS
from dreamfleet.common.artifacts.onnx_checks import has_finite_weights
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import BundleError, DatasetError
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.assemble import export_graphs, make_manifest
from dreamfleet.worker.training.data.dataset import load_arrays
from dreamfleet.worker.training.encode import encode
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel.inference import DreamStep, Encoder, PolicyStep
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import npy, parts_of
from tests.support.drives import ignore, train_models, write_drive, write_drives
from tests.support.models import random_models, weights

LAYERS, RNN = VAEConfig(latent=4, channels=(4, 4, 8, 8)), MDNRNNConfig(latent=4, hidden=8, mixtures=2)
SHORT = TrainConfig(updates=2, batch=8, rate=1e-3)
WHOLE = {INITIAL_LATENTS_PART: np.zeros((4, 2, 32), np.float32), RECORDED_STATES: np.zeros((4, 576), np.float16)}


def damaged(whole):
    """An array's content spoilt."""
    return [whole + np.nan, whole + np.inf, whole.astype(np.int64), np.array([object()]), npy(whole)[:-1], b""]


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["encoder.0.weight", "lstm.weight_ih_l0", "heads.weight"])
def test_weights_that_are_no_numbers_are_refused(tmp_path, name, value):
    models = [weights(each) for each in random_models(0, LAYERS, RNN)]
    model = next(each for each in models if name in each)
    model[name] = model[name].copy()
    model[name].flat[3] = value
    parts = export_graphs(*models, np.zeros((1, 2, 4), np.float32), LAYERS, RNN)
    with pytest.raises(BundleError):
        write_bundle(tmp_path / "b.zip", make_manifest("b", {}, FACTS, LAYERS, RNN), parts)


def test_what_ships_and_what_is_no_model_have_no_wrong_weights():
    assert has_finite_weights(find_bundle("tiny").read(POLICY))
    assert has_finite_weights(b"x")
    data = find_bundle("tiny").read(POLICY)[:2000]
    for cut in range(0, 2000, 7):
        assert has_finite_weights(data[:cut])


@pytest.mark.parametrize(
    ("part", "content"),
    [
        *((INITIAL_LATENTS_PART, np.zeros(shape, np.float32)) for shape in ((0, 2, 32), (4, 2, 16))),
        *((RECORDED_STATES, np.zeros(shape, np.float16)) for shape in ((0, 576), (16_385, 576), (4, 575), (4, 2, 576))),
        *((part, content) for part, whole in WHOLE.items() for content in damaged(whole)),
    ],
)
def test_damaged_latents_or_states_that_dreams_begin_at_are_one_clear_line(random_bundle, tmp_path, part, content):
    data = content if isinstance(content, bytes) else npy(content)
    with pytest.raises(BundleError, match=rf"b\.zip.*{re.escape(part)}") as caught:
        write_bundle(tmp_path / "b.zip", random_bundle.manifest, {**parts_of(random_bundle), part: data})
    assert "\n" not in str(caught.value)


def test_graphs_of_other_sizes_than_the_manifest_says_are_refused(random_bundle, tmp_path):
    parts = {**parts_of(random_bundle), INITIAL_LATENTS_PART: npy(np.zeros((1, 2, 16), np.float32))}
    other = write_bundle(tmp_path / "b.zip", replace(random_bundle.manifest, latent=16), parts)
    for part in (PolicyStep, DreamStep, Encoder):
        with pytest.raises(BundleError):
            part(other)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    write_drives(folder, episodes=4, steps=6)
    return train_models(folder, SHORT, LAYERS, RNN)


@pytest.fixture
def folder(trained, tmp_path):
    return shutil.copytree(trained, tmp_path / "data")


def test_a_half_written_episode_stops_training_before_its_first_update(folder):
    path = sorted((folder / "episodes").glob("*.npz"))[-1]
    path.write_bytes(path.read_bytes()[:-50])
    (folder / train_vae.CHECKPOINT).unlink()
    seen = []
    with pytest.raises(DatasetError):
        train_vae.train_vae(folder, SHORT, lambda done, _: seen.append(done), LAYERS)
    with pytest.raises(DatasetError):
        train_mdnrnn.train_mdnrnn(folder, SHORT, lambda done, _: seen.append(done), RNN)
    assert not seen


def test_an_episode_without_its_actions_is_refused(folder):
    path = sorted((folder / "episodes").glob("*.npz"))[1]
    np.savez(path, **load_arrays(path, "picture", "reward", "preprocessing", "world", "ended"))
    with pytest.raises(DatasetError, match=r"action\.npy"):
        list(encode(folder))


def test_a_half_written_encoded_episode_is_encoded_again(folder):
    path = sorted((folder / "encoded").glob("*.npz"))[1]
    whole = load_arrays(path, "mu")["mu"]
    path.write_bytes(path.read_bytes()[:100])
    assert len(list(encode(folder))) == 1
    assert np.array_equal(load_arrays(path, "mu")["mu"], whole)


def test_an_mdnrnn_of_other_latents_is_refused(folder):
    (folder / train_mdnrnn.CHECKPOINT).unlink()
    with pytest.raises(DatasetError):
        train_mdnrnn.train_mdnrnn(folder, SHORT, ignore, replace(RNN, latent=5))


def test_a_vae_of_another_size_than_the_data_is_refused_before_anything_runs(folder):
    shutil.rmtree(folder / "encoded")
    checkpoint = (folder / train_vae.CHECKPOINT).read_bytes()
    with pytest.raises(DatasetError, match=r"'box-64'.*'raw-96'.*--picture"):
        train_vae.train_vae(folder, SHORT, ignore, replace(LAYERS, picture=96), new=True)
    assert (folder / train_vae.CHECKPOINT).read_bytes() == checkpoint
    write_drive(folder, 4, picture=96)
    with pytest.raises(DatasetError, match=r"000004.npz.*'raw-96'"):
        list(encode(folder))
    assert not (folder / "encoded").exists()


def test_data_that_are_no_numbers_stop_training_and_keep_the_checkpoint(folder):
    before = (folder / train_mdnrnn.CHECKPOINT).read_bytes()
    for path in (folder / "encoded").glob("*.npz"):
        arrays = dict(np.load(path))
        np.savez(path, **{**arrays, "mu": arrays["mu"] * np.nan, "mirrored_mu": arrays["mu"] * np.nan})
    with pytest.raises(DatasetError):
        train_mdnrnn.train_mdnrnn(folder, replace(SHORT, updates=4), ignore, RNN)
    assert (folder / train_mdnrnn.CHECKPOINT).read_bytes() == before


def elsewhere(tensor):
    """The tensor, stored in another file."""
    tensor.ClearField("raw_data")
    tensor.ClearField("float_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="secret.bin")
    return tensor


def numbers():
    return elsewhere(onnx.numpy_helper.from_array(np.zeros(2, np.float32), "c"))


def constant():
    return onnx.helper.make_node("Constant", [], ["c"], value=numbers())


def branch():
    inner = onnx.helper.make_graph([], "inner", [], [], [numbers()])
    return onnx.helper.make_node("If", ["x"], ["y"], then_branch=inner, else_branch=inner)


@pytest.mark.parametrize(
    "change",
    [
        lambda model: elsewhere(model.graph.initializer[0]),
        lambda model: model.graph.node.append(constant()),
        lambda model: model.graph.node.append(branch()),
        lambda model: model.functions.append(onnx.helper.make_function("own", "f", [], ["c"], [constant()], [])),
    ],
    ids=["weights", "constant", "branch", "function"],
)
def test_a_graph_reads_no_other_file(random_bundle, tmp_path, monkeypatch, change):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secret.bin").write_bytes(bytes(10**7))
    model = onnx.load_from_string(random_bundle.read(POLICY))
    change(model)
    parts = {**parts_of(random_bundle), POLICY: model.SerializeToString()}
    with pytest.raises(BundleError, match=r"policy\.onnx"):
        write_bundle(tmp_path / "b.zip", random_bundle.manifest, parts)


@pytest.mark.parametrize(
    "change",
    [
        lambda whole: whole[:5000],
        lambda _whole: b"\x08\x08\x00\x00ORTM" + bytes(100),  # the runtime's own format
        lambda _whole: b"\xba\x80\x80\x80\x10\x00",  # field 7, if 32 bits of its number are looked at
        lambda _whole: b"\x3b\x3c",  # a group
    ],
)
def test_a_graph_that_is_cut_or_that_the_runtime_might_read_otherwise_is_not_run(random_bundle, tmp_path, change):
    parts = parts_of(random_bundle)
    parts[DREAM_GRAPH] = change(parts[DREAM_GRAPH])
    bundle = write_bundle(tmp_path / "b.zip", random_bundle.manifest, parts)
    with pytest.raises(BundleError, match=r"dream\.onnx"):
        DreamStep(bundle)


def test_a_graph_of_endless_fields_is_not_looked_through(random_bundle, tmp_path):
    parts = {**parts_of(random_bundle), DREAM_GRAPH: b"\x40\x00" * 10**6}
    with pytest.raises(BundleError, match="500000"):
        write_bundle(tmp_path / "b.zip", random_bundle.manifest, parts)


@pytest.mark.add_on
@pytest.mark.parametrize("place", ["", "episodes"])
@pytest.mark.parametrize("content", ["arrays", "half"])
def test_files_of_another_program_are_named_and_never_advised_to_be_deleted(tmp_path, place, content, capsys):
    (tmp_path / "episodes").mkdir()
    path = tmp_path / place / "000001.npz"
    np.savez(path, x=np.zeros(3), y=np.zeros(3))
    if content == "half":
        path.write_bytes(path.read_bytes()[:100])
    before = path.read_bytes()
    assert main(["pipeline", "--data", str(tmp_path), "--scale", "0.01"]) == 1
    said = capsys.readouterr().err
    assert "000001.npz" in said
    assert "--data" in said
    assert "delete" not in said
    assert not (tmp_path / "preset.json").exists()
    with pytest.raises(DatasetError, match="--data") as said:
        load_arrays(path, "action")
    assert "delete" not in str(said.value)
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.rglob("*.npz")] == ["000001.npz"]
