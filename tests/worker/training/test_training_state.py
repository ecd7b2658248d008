"""A training that is interrupted, killed, or out of disk space resumes to the same bits.
Tests training_state.py, torch_setup.py, checkpoint.py and worker/training/stages/train.py."""

import json
import os
import shutil
import signal
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from dreamfleet.common.errors import DatasetError, StoppedError, UsageError
from dreamfleet.common.files.locks import folder_lock
from dreamfleet.common.host.stop_signals import stop_on_signals
from dreamfleet.worker.training import checkpoint, torch_setup, train_mdnrnn, train_vae, training_state
from dreamfleet.worker.training.assemble import QUALITY, assemble, load_quality, record_quality
from dreamfleet.worker.training.checkpoint import load_checkpoint, load_progress, load_weights
from dreamfleet.worker.training.data.rollout_batches import load_rollouts
from dreamfleet.worker.training.encode import encode
from dreamfleet.worker.training.presets import PRESETS, TrainConfig
from dreamfleet.worker.training.stages.train import explain_interrupt
from dreamfleet.worker.training.training_state import append_point, numbered_path, select_device
from dreamfleet.worker.verbs import train as verb
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN
from dreamfleet.worker.worldmodel.mdnrnn_config import ADDABLE_HEADS, MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.disks import file_size_limit
from tests.support.drives import ignore, linked, train_models, write_drive, write_drives
from tests.support.verbs import run_verb

PLAIN = VAEConfig(latent=4, channels=(2, 2, 4, 4))
LAYERS, RNN = replace(PLAIN, batch_norm=True, dropout=0.1), MDNRNNConfig(latent=4, hidden=8, mixtures=2, dropout=0.2)
FLAGS = ("--set", "latent=4", "channels=2,2,4,4", "--batch", "8")
SHORT = TrainConfig(updates=6, batch=8, rate=1e-3, validate_every=2)
ENCODED = ("encoded", train_vae.CHECKPOINT)


class KilledError(BaseException):
    """Stands for a kill: no handler of the code under test catches it."""


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    write_drives(folder, episodes=4, steps=8)
    return train_models(folder, SHORT, LAYERS)


@pytest.fixture
def data(drives, tmp_path):
    return linked(drives, tmp_path, "episodes")


@pytest.fixture
def encoded(drives, tmp_path):
    return linked(drives, tmp_path / "data", *ENCODED)


def train(data, config=SHORT, report=ignore, layers=LAYERS, **more):
    return train_vae.train_vae(data, config, report, layers, **more)


def train_memory(folder, config=SHORT, layers=RNN, report=ignore, **more):
    train_mdnrnn.train_mdnrnn(folder, config, report, layers, **more)
    return folder / train_mdnrnn.CHECKPOINT


def call(data, *words):
    return run_verb(verb, "vae", "--data", data, *words, *FLAGS)


def state(path):
    return {name: array.tobytes() for name, array in load_weights(path).items()}, load_progress(path)


def made(folder):
    return sorted(path.name for path in folder.iterdir() if path.name != "episodes")


def test_a_vae_that_is_worse_than_the_mean_picture_logs_a_warning(data, caplog):
    figures = train(data, layers=PLAIN)
    assert figures["reconstruction_error"] > figures["mean_picture_error"]
    assert "--updates" in caplog.text


def test_a_training_goes_on_by_the_seed_that_it_was_begun_with(data):
    train(data)
    with pytest.raises(UsageError, match=r"--seed 0.*--seed 3.*--seed 0"):
        train(data, replace(SHORT, updates=8, seed=3))
    assert load_progress(data / "vae.safetensors")["update"] == 6
    train(data, replace(SHORT, seed=3), new=True)
    assert load_progress(data / "vae.safetensors")["seed"] == 3


@pytest.mark.slow
@pytest.mark.parametrize(("updates", "rate"), [(8, 1e-12), (4, 1e-3)])  # the first ends early
def test_a_kill_at_any_write_of_a_checkpoint_leads_to_the_same_files(drives, tmp_path, monkeypatch, updates, rate):
    config, writes = replace(SHORT, updates=updates, rate=rate, patience=2, keep_every=3), []

    def killed_at(number):
        def write(*given):
            writes.append(given[0])
            if len(writes) == number:
                raise KilledError
            checkpoint.save_checkpoint(*given)

        writes.clear()
        monkeypatch.setattr(training_state, "save_checkpoint", write)

    def files(folder):
        train_memory(folder, config)
        return {path.name: state(path) for path in folder.glob("mdnrnn.*safetensors")}

    killed_at(0)
    expected = files(linked(drives, tmp_path / "whole", *ENCODED))
    assert (expected["mdnrnn.safetensors"][1].get("stopped") is not None) == (rate == 1e-12)
    for number in range(1, len(writes) + 1):
        folder = linked(drives, tmp_path / f"{number}", *ENCODED)
        killed_at(number)
        with pytest.raises(KilledError):
            files(folder)
        assert files(folder) == expected


def test_a_full_disk_is_one_line_and_the_last_checkpoint_stays(drives, data):
    with file_size_limit() as limit, pytest.raises(DatasetError, match=r"vae\.safetensors"):
        train(data, report=lambda done, _: limit(2000) if done == 3 else None)
    assert load_progress(data / train_vae.CHECKPOINT)["update"] == 2
    assert made(data) == ["vae.jsonl", "vae.safetensors"]
    train(data)
    assert state(data / train_vae.CHECKPOINT) == state(drives / train_vae.CHECKPOINT)


def test_a_point_of_the_curve_is_whole_or_not_there(tmp_path):
    path = tmp_path / "vae.jsonl"
    append_point(path, update=20, error=1.0)
    with file_size_limit() as limit:
        limit(path.stat().st_size + 5)
        with pytest.raises(DatasetError):
            append_point(path, update=40, error=1.0)
    append_point(path, update=60, error=1.0)
    assert [json.loads(line)["update"] for line in path.read_text().splitlines()] == [20, 60]


def test_signals_wait_until_a_checkpoint_is_written(data, monkeypatch):
    real = checkpoint.save

    def signalled(*given):
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.raise_signal(number)
        return real(*given)

    monkeypatch.setattr(checkpoint, "save", signalled)
    with pytest.raises(KeyboardInterrupt), stop_on_signals() as stop:
        train(data, stop=stop)
    assert load_progress(data / train_vae.CHECKPOINT)["update"] == 2
    assert made(data) == ["vae.jsonl", "vae.safetensors"]


@pytest.mark.parametrize("new", [False, True])
def test_a_second_signal_says_what_is_kept(data, new):
    def twice(done, _note):
        if done == 3:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGTERM)

    with (
        pytest.raises(StoppedError, match=r"vae\.safetensors.* 2") as stopped,
        explain_interrupt(data / train_vae.CHECKPOINT, new),
        stop_on_signals() as stop,
    ):
        train(data, SHORT, twice, stop=stop)
    assert ("--new" in str(stopped.value)) == new


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\xff", b'{"done_auc": "high"}', b"[" * 9000])
def test_damaged_figures_are_replaced_by_a_training_and_named_for_a_bundle(data, content, caplog):
    (data / QUALITY).write_bytes(content)
    with pytest.raises(DatasetError, match=QUALITY):
        load_quality(data)
    record_quality(data, {"error": 2.0})
    assert QUALITY in caplog.text
    record_quality(data, {"kl": 1.0})
    assert load_quality(data) == {"error": 2.0, "kl": 1.0}


def test_a_second_training_of_a_model_in_a_folder_is_refused(data):
    with folder_lock(data / "vae.lock", "other"), pytest.raises(UsageError, match="VAE"):
        call(data, "--updates", 1)
    with folder_lock(data / "mdnrnn.lock", "other"):
        assert call(data, "--updates", 1) == 0


def test_a_training_without_data_makes_no_folder(tmp_path):
    with pytest.raises(DatasetError, match="missing"):
        call(tmp_path / "missing", "--updates", 1)
    assert not (tmp_path / "missing").exists()


def test_checkpoints_are_kept_beside_the_last_one(drives, data):
    train(data, replace(SHORT, keep_every=4, updates=5))
    last, kept = data / train_vae.CHECKPOINT, numbered_path(data / train_vae.CHECKPOINT, 4)
    assert kept.name == "vae.000004.safetensors"
    assert (load_progress(last)["update"], load_progress(kept)["update"]) == (5, 4)
    last.write_bytes(kept.read_bytes())
    train(data)
    assert state(last) == state(drives / train_vae.CHECKPOINT)
    with pytest.raises(UsageError, match="keep_every"):
        replace(SHORT, keep_every=-1)


def test_an_early_end_is_said_and_again_where_nothing_is_left_to_do(data, capsys):
    words = (data, "--updates", 20, "--rate", 1e-12, "--set", "validate_every=1", "patience=2")
    assert call(*words) == 0
    assert "--patience" in capsys.readouterr().out
    assert call(*words, "--json") == 0
    ended = json.loads(capsys.readouterr().out)["ended_early"]
    assert (ended["update"], ended["given_up_at"]) == (1, 3)
    point = json.loads((data / "vae.jsonl").read_text().splitlines()[0])
    assert ended["held_out_loss"] == pytest.approx(point["held_out"], abs=1e-5)
    assert "ended_early" not in json.loads((data / "quality.json").read_text())
    assert call(*words, "--set", "patience=0", "--updates", 2, "--json") == 0
    assert json.loads(capsys.readouterr().out)["ended_early"] is None


def test_patience_that_comes_later_counts_from_then(data):
    still = replace(SHORT, rate=1e-12, updates=2, validate_every=1)
    train(data, still, layers=PLAIN)
    (data / "vae.best.safetensors").write_bytes(b"of another training, and damaged")
    train(data, replace(still, updates=20, patience=1), layers=PLAIN)
    found = load_progress(data / train_vae.CHECKPOINT)
    assert (found["update"], found["given_up_at"]) == (3, 4)


def test_new_begins_anew_and_leaves_nothing_of_the_old_training(drives, data, capsys):
    train(data, replace(SHORT, updates=3, patience=2, keep_every=2, seed=7))
    before = load_weights(data / train_vae.CHECKPOINT)
    updates = []
    train(data, report=lambda done, _: updates.append(done), new=True)
    assert updates == list(range(7))
    assert made(data) == ["vae.jsonl", "vae.safetensors"]
    assert state(data / train_vae.CHECKPOINT) == state(drives / train_vae.CHECKPOINT)
    assert (data / "vae.jsonl").read_text() == (drives / "vae.jsonl").read_text()
    assert not np.array_equal(before["mu.weight"], load_weights(data / train_vae.CHECKPOINT)["mu.weight"])
    assert call(data, "--updates", 1, "--new", "--seed", 3) == 0
    assert load_progress(data / train_vae.CHECKPOINT)["update"] == 1


def test_layers_of_another_model_are_refused_before_a_bar_is_drawn(data, capsys):
    train(data, replace(SHORT, updates=1), layers=PLAIN)
    capsys.readouterr()
    with pytest.raises(DatasetError, match="latent 4, not 6"):
        run_verb(verb, "vae", "--data", data, "--set", "latent=6", "channels=2,2,4,4")
    assert capsys.readouterr().err == ""


def test_new_begins_from_a_kept_checkpoint_and_never_from_what_it_replaces(data):
    again = partial(train, data, layers=PLAIN)
    again(replace(SHORT, keep_every=2))
    last, kept = data / train_vae.CHECKPOINT, numbered_path(data / train_vae.CHECKPOINT, 4)
    before = last.read_bytes()
    for named, wrong in (
        (r"--new.*--continue-from", {"continue_from": data / "." / last.name}),
        (r"--decoder-only.*--continue-from", {"decoder_only": True}),
        (r"absent\.safetensors", {"continue_from": data / "absent.safetensors"}),
    ):
        with pytest.raises(UsageError, match=named):
            again(new=True, **wrong)
    assert last.read_bytes() == before
    again(replace(SHORT, updates=1, rate=1e-12), continue_from=kept, new=True)
    one, other = load_weights(kept), load_weights(last)
    assert all(np.allclose(one[name], other[name], atol=1e-9) for name in one)
    assert made(data) == ["vae.000004.safetensors", "vae.jsonl", "vae.safetensors"]


@pytest.mark.parametrize("after", [1, 3])  # neither is an update after which the held-out rollouts are looked at
def test_a_stopped_training_keeps_every_update_and_resumes_to_the_same_bits(drives, data, after):
    done = []
    with pytest.raises(StoppedError, match=rf"{after}.*vae\.safetensors"):
        train(data, report=lambda number, _: done.append(number), stop=lambda: done[-1] == after)
    assert load_progress(data / train_vae.CHECKPOINT)["update"] == after
    train(data)
    assert state(data / train_vae.CHECKPOINT) == state(drives / train_vae.CHECKPOINT)


def test_a_decoder_that_learns_on_leaves_latents_and_mdnrnn_as_they_are(drives, tmp_path):
    before, folder = load_weights(drives / train_vae.CHECKPOINT), shutil.copytree(drives, tmp_path / "data")
    train_memory(folder)
    train(folder, replace(SHORT, updates=8), decoder_only=True)
    after = load_weights(folder / train_vae.CHECKPOINT)
    changed = {name for name in before if not np.array_equal(before[name], after[name])}
    assert changed
    assert all(name.startswith(("decoder.", "dense.")) for name in changed)
    assert list(encode(folder)) == []
    assemble(folder, tmp_path / "b.zip", "b", with_weights=False)


def test_a_decoder_alone_needs_an_encoder(drives, data):
    with pytest.raises(UsageError, match="--continue-from"):
        train(data, decoder_only=True)
    source = drives / train_vae.CHECKPOINT
    train(data, continue_from=source, decoder_only=True)
    assert state(source)[0] != state(data / train_vae.CHECKPOINT)[0]


def test_a_done_head_can_be_added_to_a_trained_mdnrnn(encoded, tmp_path):
    """Its weights stay, to the bit; Adam's moments too, except those of extended tensors."""
    before, ending = train_memory(encoded).rename(tmp_path / "before.safetensors"), replace(RNN, done=True, lost=3)
    torch.manual_seed(4)
    grown = MDNRNN(ending)
    optimiser = torch.optim.Adam(grown.parameters())
    own = grown.state_dict()["heads.weight"][-1].clone()
    assert load_checkpoint(before, grown, optimiser, ADDABLE_HEADS)
    for name, tensor in load_weights(before).items():
        assert np.array_equal(grown.state_dict()[name][: len(tensor)].numpy(), tensor)
    assert torch.equal(grown.state_dict()["heads.weight"][-1], own)
    shapes = [each.shape for each in grown.parameters()]
    moments = optimiser.state_dict()["state"]
    assert moments
    assert all(state["exp_avg"].shape == shapes[index] for index, state in moments.items())
    other = train_memory(encoded, layers=ending, continue_from=before).rename(tmp_path / "ending.safetensors")
    with pytest.raises(DatasetError):
        load_checkpoint(other, MDNRNN(replace(ending, lost=5)), None, ADDABLE_HEADS)
    with pytest.raises(DatasetError):
        train_memory(encoded, continue_from=other)


def test_a_checkpoint_that_is_cut_short_is_not_filled_up(encoded):
    path = train_memory(encoded)
    whole = load_file(path)
    with safe_open(path, "pt") as file:
        about = file.metadata()
    save_file(whole | {"model.heads.bias": whole["model.heads.bias"][:2].contiguous()}, path, about)
    with pytest.raises(DatasetError):
        load_checkpoint(path, MDNRNN(RNN), None, ADDABLE_HEADS)


def test_training_ends_when_held_out_drives_gain_nothing_and_goes_on_with_new_ones(tmp_path):
    write_drives(tmp_path, episodes=4, steps=8)
    path, seen = tmp_path / train_vae.CHECKPOINT, []
    impatient = TrainConfig(updates=40, batch=8, rate=1e-12, patience=2, validate_every=1)

    def progress(config):
        seen.clear()
        train(tmp_path, config, lambda done, _: seen.append(done), PLAIN)
        return load_progress(path)

    ended = progress(impatient)
    kept = path.read_bytes()
    assert ended["stopped"] == 3
    assert ended["update"] < 40
    progress(impatient)
    assert seen == [ended["update"]]
    assert progress(replace(impatient, patience=0, updates=ended["update"] + 1))["update"] == ended["update"] + 1
    path.write_bytes(kept)
    write_drive(tmp_path, 4, steps=8)
    progress(impatient)
    assert len(seen) > 1


@pytest.mark.parametrize("name", PRESETS)
def test_every_presets_layers_train_and_foresee(encoded, name):
    layers = replace(PRESETS[name].mdnrnn_layers, latent=4, hidden=8, done=True)
    figures = train_mdnrnn.train_mdnrnn(encoded, SHORT, ignore, layers)
    assert "nats_per_dimension" in figures
    assert any(name in figures for name in ("reward_auc", "reward_rmse")) == layers.has_reward_head


@pytest.mark.parametrize("columns", [0, 2])
def test_a_model_with_joint_mixtures_trains_and_foresees(encoded, columns):
    layers = MDNRNNConfig(latent=4, hidden=8, joint=True, columns=columns)
    assert "nats_per_dimension" in train_mdnrnn.train_mdnrnn(encoded, SHORT, ignore, layers)


def test_a_batch_in_chunks_has_the_same_gradients(drives, monkeypatch):
    model = MDNRNN(replace(RNN, dropout=0.0, done=True))
    rollouts = load_rollouts(sorted((drives / "encoded").glob("*.npz")))
    rollouts.logvar.fill_(-100)  # chance is drawn a chunk at a time
    found = []
    for steps in (10_000, 1):
        monkeypatch.setattr("dreamfleet.worker.training.data.rollout_batches.CHUNK_STEPS", steps)
        model.zero_grad()
        values = train_mdnrnn.backward(model, rollouts, torch.Generator().manual_seed(0))
        found.append((values, [each.grad.clone() for each in model.parameters() if each.requires_grad]))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-5)
    for one, other in zip(found[0][1], found[1][1], strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-4)


def test_a_device_that_is_not_there_is_refused():
    assert select_device("auto").type in ("cpu", "cuda")
    with pytest.raises(UsageError):
        select_device("abacus")


@pytest.fixture
def allocator_calls(monkeypatch):
    """The calls of the C library's allocator settings."""
    calls = []
    for name in [each for each in os.environ if each.startswith(("MALLOC_", "OMP_WAIT"))]:
        monkeypatch.delenv(name)
    monkeypatch.setattr(torch_setup, "_keep_freed_memory", lambda: calls.append("keep"))
    yield calls
    os.environ.pop("OMP_WAIT_POLICY", None)


def test_threads_that_wait_sleep_and_the_heap_keeps_what_is_freed_unless_the_user_set_otherwise(
    allocator_calls, monkeypatch
):
    torch_setup.configure_process()
    assert (os.environ["OMP_WAIT_POLICY"], allocator_calls) == ("PASSIVE", ["keep"])
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    monkeypatch.setenv("MALLOC_ARENA_MAX", "2")
    torch_setup.configure_process()
    assert (os.environ["OMP_WAIT_POLICY"], allocator_calls) == ("ACTIVE", ["keep"])


def test_a_system_without_such_a_heap_is_left_alone(monkeypatch):
    asked = []

    class Library:
        def __getattr__(self, name):
            asked.append(name)
            raise AttributeError(name)

    monkeypatch.setattr(torch_setup.ctypes, "CDLL", lambda _name: Library())
    torch_setup._keep_freed_memory()
    assert asked == ["mallopt"]
