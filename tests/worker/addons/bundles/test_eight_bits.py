"""World models whose encoder and LSTM multiply eight-bit integers; checkpoints from a bundle's models.
Tests extract.py, unbundle.py, weights_from_graphs.py, worker/worldmodel/eight_bits.py and
worker/worldmodel/onnx_graph.py."""

import json
import os
import platform
import subprocess
import sys
from dataclasses import replace

import numpy as np
import onnx
import pytest
from onnx import TensorProto, numpy_helper
from safetensors.numpy import save

from dreamfleet.common.artifacts.bundle import DECODER, DREAM_GRAPH, ENCODER, POLICY, WEIGHTS, write_bundle
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import BundleError, ControllerError, DatasetError, UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.schema.validation import from_plain
from dreamfleet.worker.addons.bundles.eight_bits import write_eight_bit_bundle
from dreamfleet.worker.addons.bundles.unbundle import restore_models, unbundle
from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.training import train_mdnrnn
from dreamfleet.worker.training.assemble import export_graphs
from dreamfleet.worker.training.checkpoint import load_config, load_progress, load_weights
from dreamfleet.worker.training.encode import encode, encoder_hash
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel.eight_bits import PIXEL_STEP, Ranges, add_convolution, round_weights_exactly
from dreamfleet.worker.worldmodel.export import export_dream
from dreamfleet.worker.worldmodel.inference import DreamStep, Encoder, PolicyStep, open_graph
from dreamfleet.worker.worldmodel.mdnrnn_config import ATTENTIVE, MDNRNNConfig
from dreamfleet.worker.worldmodel.onnx_graph import GraphBuilder
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import parts_of, write_random_bundle
from tests.support.drives import ignore, write_drives
from tests.support.models import random_models, weights

EYES = VAEConfig(latent=4, channels=(4, 6, 8, 8))
MEMORY = MDNRNNConfig(latent=4, hidden=6)


@pytest.fixture
def whole(tmp_path):
    return write_random_bundle(tmp_path / "whole.zip", 3, EYES, MEMORY)


@pytest.fixture
def rounded(whole, tmp_path):
    return write_eight_bit_bundle(whole, tmp_path / "rounded.zip")


def pictures(count):
    return np.random.default_rng(1).integers(0, 256, (count, 64, 64, 3), np.uint8)


def convolve(value, kernel, stride):
    """Integers (N, C, H, W) with a kernel (O, C, K, K), summed in 64 bits."""
    size = kernel.shape[-1]
    windows = np.lib.stride_tricks.sliding_window_view(value, (size, size), axis=(2, 3))[:, :, ::stride, ::stride]
    return np.einsum("nchwij,ocij->nohw", windows.astype(np.int64), kernel.astype(np.int64))


def constants_of(graph, operator, *inputs):
    """Constants at these inputs of each node of an operator, in the order of the nodes."""
    graph = onnx.load_model_from_string(graph).graph
    found = {each.name: numpy_helper.to_array(each) for each in graph.initializer}
    return [[found[node.input[each]] for each in inputs] for node in graph.node if node.op_type == operator]


def test_the_encoder_sums_integers_exactly(whole, rounded):
    models, seen = restore_models(whole), pictures(3)
    ranges = from_plain(Ranges, rounded.manifest.models["eight_bits"])
    value, step = seen.transpose(0, 3, 1, 2).astype(np.int64), PIXEL_STEP
    for index, (kernels, steps) in enumerate(constants_of(rounded.read(ENCODER), "QLinearConv", 3, 4)):
        kernel, bias = (models.vae[f"encoder.{index * EYES.modules_a_layer}.{part}"] for part in ("weight", "bias"))
        exact = kernel / steps[:, None, None, None]
        assert np.abs(kernels - exact).max() < 1
        assert np.abs((kernels - exact).sum(axis=(2, 3))).max() <= 0.5 + 1e-4
        assert np.abs(kernels).max() == 63
        whole_bias = np.rint(bias / (steps.astype(np.float64) * step)).astype(np.int64)
        total = convolve(value, kernels, EYES.down[index].stride) + whole_bias[:, None, None]
        scale = (steps * np.float32(step) / ranges.step_of(index)).astype(np.float32)
        value = np.clip(np.rint(total.astype(np.float32) * scale[:, None, None]), 0, 255).astype(np.int64)
        step = ranges.step_of(index)
    (large, scale), (small, rest) = constants_of(rounded.read(ENCODER), "MatMulIntegerToFloat", 1, 3)[:2]
    assert np.abs(large * (scale / step) + small * (rest / step) - models.vae["mu.weight"].T).max() < 2e-5
    flat = value.reshape(3, -1)
    expected = (
        (flat @ large).astype(np.float32) * scale + models.vae["mu.bias"] + (flat @ small).astype(np.float32) * rest
    )
    assert np.abs(Encoder(rounded).encode(seen)[0] - expected).max() < 1e-6


@pytest.mark.parametrize("centred", [True, False])
def test_a_sum_of_integers_and_its_scale_have_an_exact_product(centred):
    kernel, step = np.random.default_rng(1).normal(0, 1, (300, 8)).astype(np.float32), np.float32(0.0123)
    weights, scale = round_weights_exactly(kernel, step, centred=centred)
    extremes = np.where(weights > 0, 127 if centred else 255, -128 if centred else 0)
    assert 32 <= np.abs(weights).max() <= 63
    for inputs in (extremes, np.random.default_rng(2).permuted(extremes)):
        sums = (inputs * weights.astype(np.int64)).sum(axis=0)
        assert (sums.astype(np.float32) == sums).all()
        assert (sums.astype(np.float32) * scale == sums * scale.astype(np.float64)).all()
    assert np.abs(weights * (scale / step) - kernel).max() <= (scale / step).max() / 2 * (1 + 1e-6)


def test_a_bias_far_above_its_kernel_does_not_overflow():
    graph, picture = GraphBuilder("convolution"), np.zeros((1, 3, 4, 4), np.uint8)
    value = graph.add_input("value", TensorProto.UINT8, 3, 4, 4)
    kernel, bias = np.full((2, 3, 4, 4), 1e-12, np.float32), np.array([0.4, 0.2], np.float32)
    steps = PIXEL_STEP, np.float32(1 / 255)
    graph.add_output(add_convolution(graph, value, kernel, bias, steps, {}), "out", TensorProto.UINT8, 2, 1, 1)
    (found,) = open_graph(graph.build(), 1).run(None, {"value": picture})
    assert found.ravel().tolist() == [102, 51]


def test_a_candidate_whose_actions_are_no_numbers_has_no_fitness(rounded):
    parameters = np.zeros(rounded.controller_shape.size, np.float32)
    parameters[::2], parameters[1::2] = 3e38, -3e38
    batch = DreamBatch(rounded, TaskSpec("dream", rounded.sha256, horizon=5, patience=0))
    wild, tame = batch.score([(parameters, 1), (np.zeros_like(parameters), 1)])
    assert not np.isfinite(wild.fitness)
    assert np.isfinite(tame.fitness)


def test_it_sees_and_dreams_nearly_as_before(whole, rounded):
    seen, rng = pictures(8), np.random.default_rng(2)
    before, after = (Encoder(each).encode(seen)[0] for each in (whole, rounded))
    assert np.abs(after - before).max() < 0.05 * np.abs(before).max()
    action, state = rng.uniform(-1, 1, (8, 3)).astype(np.float32), DreamStep(whole).zero_state(8)
    kept = [DreamStep(each).advance(before, action, state) for each in (whole, rounded)]
    assert 0 < np.abs(kept[1] - kept[0]).max() < 0.02


def test_a_model_in_columns_dreams_nearly_as_before(tmp_path):
    whole = write_random_bundle(tmp_path / "a.zip", 3, EYES, replace(MEMORY, columns=2, done=True))
    rounded, rng = write_eight_bit_bundle(whole, tmp_path / "b.zip"), np.random.default_rng(2)
    latent, action, normal = (rng.uniform(-1, 1, (8, size)).astype(np.float32) for size in (4, 3, 4))
    state = DreamStep(whole).zero_state(8)
    one, other = (
        DreamStep(each).imagine(latent, action, state, np.abs(latent), normal, 1.0) for each in (whole, rounded)
    )
    assert 0 < np.abs(other.latent - one.latent).max() < 0.05
    assert 0 < np.abs(other.done - one.done).max() < 0.02


@pytest.mark.parametrize("memory", [MEMORY, replace(MEMORY, done=True)])
def test_a_row_has_the_bits_that_it_has_alone_and_reality_those_of_dreams(tmp_path, memory):
    rounded = write_eight_bit_bundle(write_random_bundle(tmp_path / "a.zip", 3, EYES, memory), tmp_path / "b.zip")
    policy, seen = PolicyStep(rounded), pictures(7)
    parameters = np.random.default_rng(2).normal(0, 1, (7, rounded.controller_shape.size)).astype(np.float32)
    state = policy.step(seen, parameters, policy.zero_state(7)).state
    together = policy.step(seen, parameters, state)
    for row in range(7):
        alone = policy.step(*(np.ascontiguousarray(each[row : row + 1]) for each in (seen, parameters, state)))
        assert all((one[0] == all_[row]).all() for one, all_ in zip(alone, together, strict=True))
    assert (DreamStep(rounded).advance(together.latent, together.action, state) == together.state).all()
    assert (Encoder(rounded).encode(seen)[0] == together.latent).all()


@pytest.mark.parametrize(
    "memory", [replace(MEMORY, reward="value", previous_reward=True), replace(ATTENTIVE, latent=4, hidden=6, window=3)]
)
def test_an_lstm_with_inputs_of_unknown_size_stays_as_it_is(tmp_path, memory):
    whole = write_random_bundle(tmp_path / "whole.zip", 3, EYES, memory)
    rounded = write_eight_bit_bundle(whole, tmp_path / "rounded.zip")
    assert rounded.read(DREAM_GRAPH) == whole.read(DREAM_GRAPH)
    assert rounded.read(ENCODER) != whole.read(ENCODER)


def test_controllers_of_the_whole_world_model_drive_by_the_rounded_one_and_not_the_other_way(whole, rounded):
    vector = np.zeros(whole.controller_shape.size, np.float32)
    old, new = (Controller(each.controller_shape, vector, "car-racing", each.sha256) for each in (whole, rounded))
    assert rounded.for_controller(old).sha256 == rounded.sha256
    with pytest.raises(ControllerError):
        whole.for_controller(new)
    assert find_bundle("tiny-int8").same_models[1] == find_bundle("tiny").sha256


def test_training_resumes_from_what_was_rounded_alone(whole, rounded, tmp_path):
    with pytest.raises(BundleError, match=whole.sha256[:12]):
        unbundle(rounded, tmp_path / "data")


def leaky(_whole, path):
    return write_random_bundle(path, 3, replace(EYES, activation="leaky_relu"), MEMORY)


def wild(whole, path):
    """Its dreams lose their world, so that they give no ranges."""
    weights, numbers = restore_models(whole).mdnrnn, MEMORY.mixtures * MEMORY.latent
    weights["heads.bias"][-2 * numbers :] = 30  # of means and deviations
    parts = parts_of(whole) | {DREAM_GRAPH: export_dream(weights, MEMORY)}
    return write_bundle(path, replace(whole.manifest, parts={}), parts)


@pytest.mark.parametrize("make", [leaky, wild, write_eight_bit_bundle])
def test_what_cannot_be_rounded_is_refused(whole, tmp_path, make):
    with pytest.raises(BundleError):
        write_eight_bit_bundle(make(whole, tmp_path / "a.zip"), tmp_path / "b.zip")
    assert not (tmp_path / "b.zip").exists()


def test_the_verb_writes_the_same_file_twice(whole, tmp_path):
    files = [tmp_path / name / "fast.zip" for name in "ab"]
    for file in files:
        file.parent.mkdir()
        assert main(["bundle", "--from", str(whole.path), "--out", str(file)]) == 0
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.parametrize(
    ("more", "flag"),
    [
        (["--out", "x.zip", "--recorded", "3"], "--recorded"),
        (["--extract", "tiny"], "--out"),
        (["--out", "fast.zip", "--recorded", "0"], "--recorded"),
        (["--out", "fast.zip", "--with-weights"], "--with-weights"),
    ],
)
def test_flags_that_do_not_fit_are_refused(more, flag, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["bundle", "--from", "tiny", *more]) == 2
    assert flag in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


PROGRAM = """
import sys
from dreamfleet import Scorer, TaskSpec, find_bundle, find_controller
bundle = find_bundle(sys.argv[1])
for task in ("car-racing", "dream"):
    scorer = Scorer(TaskSpec(task, bundle.sha256, horizon=20, patience=0), bundle)
    print(task, scorer.host_class, scorer.score("score", find_controller("tiny").parameters, seed=2**20))
"""


def output_of(bundle, *emulator):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "SDL_VIDEODRIVER": "dummy"}
    command = [*emulator, os.path.realpath(sys.executable), "-W", "ignore", "-c", PROGRAM, str(bundle.path)]
    return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.splitlines()


@pytest.mark.slow
@pytest.mark.needs_programs("qemu-x86_64")
@pytest.mark.skipif(platform.machine() != "x86_64", reason="emulates another x86 processor")
def test_class_and_score_are_those_of_a_processor_without_avx512(tmp_path):
    rounded = write_eight_bit_bundle(find_bundle("tiny"), tmp_path / "rounded.zip")
    here = output_of(rounded)
    assert [line.split()[0] for line in here] == ["car-racing", "dream"]
    assert output_of(rounded, "qemu-x86_64", "-cpu", "Haswell") == here


NARROW = VAEConfig(latent=4, channels=(2, 3, 2, 2))


@pytest.fixture
def plain(tmp_path):
    return write_random_bundle(tmp_path / "a.zip", 3, NARROW, MEMORY)


@pytest.mark.parametrize(
    ("eyes", "memory"),
    [
        *((replace(NARROW, **eyes), MEMORY) for eyes in (
            {}, {"picture": 96, "padding": "same"}, {"dropout": 0.1, "activation": "leaky_relu"}, {"dense": 8},
            {"activate_dense": True}, {"columns": 1, "channels": (2, 2, 2, 4), "padding": "same"},
        )),
        *((NARROW, replace(MEMORY, **memory)) for memory in (
            {"done": True, "lost": 9}, {"reward": "none", "mixtures": 1}, {"joint": True, "done": True},
            {"columns": 2, "done": True},
            {"columns": 2, "previous_reward": True, "reward": "value"}, {"columns": 2, "reward": "none"},
            {"reward": "value", "previous_reward": True, "dropout": 0.1},
        )),
        (NARROW, replace(ATTENTIVE, latent=4, hidden=6, window=3, attention_units=5)),
    ],
)  # fmt: skip
def test_the_same_graphs_are_bundled_from_it_again_and_nothing_was_learnt_yet(tmp_path, eyes, memory):
    bundle = write_random_bundle(tmp_path / "a.zip", 3, eyes, memory)
    vae, rnn = unbundle(bundle, tmp_path)
    again = export_graphs(
        load_weights(vae), load_weights(rnn), np.zeros((1, 2, 4), np.float32), load_config(vae, VAEConfig),
        load_config(rnn, MDNRNNConfig),
    )  # fmt: skip
    assert all(again[name] == bundle.read(name) for name in (ENCODER, DECODER, DREAM_GRAPH, POLICY))
    assert load_progress(vae) == {"update": 0}
    assert load_progress(rnn) == {"update": 0, "vae": encoder_hash(tmp_path)}


def test_training_goes_on_from_it_also_with_a_head_more(plain, tmp_path):
    write_drives(tmp_path, episodes=3, steps=8)
    unbundle(plain, tmp_path)
    assert len(list(encode(tmp_path))) == 3
    rnn = tmp_path / train_mdnrnn.CHECKPOINT
    before = load_weights(rnn)
    few, ending = TrainConfig(updates=1, batch=2, rate=1e-9), replace(MEMORY, done=True, lost=4)
    train_mdnrnn.train_mdnrnn(tmp_path, few, ignore, ending)
    for name, values in load_weights(rnn).items():
        np.testing.assert_allclose(values[: len(before[name])], before[name], atol=1e-6)
    assert load_config(rnn, MDNRNNConfig) == ending
    with pytest.raises(DatasetError):
        train_mdnrnn.train_mdnrnn(tmp_path, replace(few, updates=2), ignore, MEMORY)


def test_weights_that_a_bundle_keeps_are_taken_as_they_were(tmp_path):
    plain = write_random_bundle(tmp_path / "a.zip", 3, replace(NARROW, batch_norm=True), MEMORY)
    trained = random_models(3, replace(NARROW, batch_norm=True), MEMORY)
    kept = {f"{name}.{each}": values for name, model in zip(("vae", "mdnrnn"), trained, strict=True)
            for each, values in weights(model).items()}  # fmt: skip
    parts = parts_of(plain)
    whole = write_bundle(tmp_path / "b.zip", plain.manifest, parts | {WEIGHTS: save(kept)})
    unbundle(whole, tmp_path / "kept")
    for model in ("vae", "mdnrnn"):
        for name, values in load_weights(tmp_path / "kept" / f"{model}.safetensors").items():
            assert np.array_equal(values, kept[f"{model}.{name}"])
    for wrong in (np.float32(np.nan), np.float32(1)):
        other = save({name: values + wrong if name == "vae.mu.bias" else values for name, values in kept.items()})
        lying = write_bundle(tmp_path / "c.zip", plain.manifest, parts | {WEIGHTS: other})
        with pytest.raises(BundleError):
            unbundle(lying, tmp_path / "other")


@pytest.mark.parametrize(
    ("eyes", "memory"),
    [
        (replace(NARROW, batch_norm=True), MEMORY),
        (NARROW, replace(MEMORY, window=2)),
        (NARROW, replace(MEMORY, done=True)),
        (replace(NARROW, channels=(2, 2, 2, 2)), MEMORY),
        (replace(NARROW, activation="leaky_relu"), MEMORY),
        (NARROW, replace(MEMORY, reward="value")),
    ],
)
def test_models_that_cannot_be_restored_are_refused(plain, tmp_path, eyes, memory):
    """The manifest of one bundle with the graphs of another."""
    other = write_random_bundle(tmp_path / "b.zip", 3, eyes, memory)
    manifest = replace(plain.manifest, models=other.manifest.models)
    with pytest.raises(BundleError):
        unbundle(write_bundle(tmp_path / "c.zip", manifest, parts_of(plain)), tmp_path / "data")
    assert not list(tmp_path.glob("data/*"))


@pytest.mark.parametrize("part", [ENCODER, DECODER, DREAM_GRAPH])
def test_a_graph_that_is_none_is_refused_in_a_line(plain, tmp_path, part):
    parts = parts_of(plain) | {part: b"\0junk" * 100}
    with pytest.raises(BundleError):
        unbundle(write_bundle(tmp_path / "b.zip", plain.manifest, parts), tmp_path / "data")


def test_where_one_of_both_cannot_be_written_neither_is(plain, tmp_path, monkeypatch):
    def full(path, *_):
        if path.name == train_mdnrnn.CHECKPOINT:
            raise DatasetError("no space left")
        path.write_bytes(b"")

    with monkeypatch.context() as patch:
        patch.setattr("dreamfleet.worker.addons.bundles.unbundle.save_checkpoint", full)
        patch.setattr("dreamfleet.worker.addons.bundles.unbundle.encoder_hash", lambda _: "")
        with pytest.raises(DatasetError):
            unbundle(plain, tmp_path / "data")
    unbundle(plain, tmp_path / "data")
    with pytest.raises(DatasetError):
        unbundle(plain, tmp_path / "a.zip")


def test_models_that_are_there_stay(plain, tmp_path, capsys):
    assert main(["bundle", "--extract", str(plain.path), "--data", str(tmp_path / "data"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["bundle"] == plain.sha256
    before = (tmp_path / "data" / "vae.safetensors").read_bytes()
    with pytest.raises(UsageError):
        unbundle(plain, tmp_path / "data")
    assert (tmp_path / "data" / "vae.safetensors").read_bytes() == before
