"""A training that is interrupted, killed, or out of disk space resumes to the same bits.
Tests worker/training/stages/train.py."""

import json
import resource
import signal
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.errors import DatasetError, StoppedError, UsageError
from dreamfleet.common.files.locks import folder_lock
from dreamfleet.common.host.stop_signals import stop_on_signals
from dreamfleet.worker.training import checkpoint, train_mdnrnn, train_vae, training_state
from dreamfleet.worker.training.assemble import QUALITY, load_quality, record_quality
from dreamfleet.worker.training.checkpoint import load_progress, load_weights
from dreamfleet.worker.training.encode import encode
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.training.stages.train import explain_interrupt
from dreamfleet.worker.training.training_state import append_point, numbered_path
from dreamfleet.worker.verbs import train as verb
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.drives import ignore, write_drives
from tests.support.verbs import run_verb

LAYERS, RNN = VAEConfig(latent=4, channels=(2, 2, 4, 4)), MDNRNNConfig(latent=4, hidden=8, mixtures=2)
FLAGS = ("--set", "latent=4", "channels=2,2,4,4", "--batch", "8")
SHORT = TrainConfig(updates=6, batch=8, rate=1e-3, validate_every=2)


class KilledError(BaseException):
    """Stands for a kill: no handler of the code under test catches it."""


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    write_drives(folder, episodes=4, steps=8)
    train_vae.train_vae(folder, SHORT, ignore, LAYERS)
    assert len(list(encode(folder))) == 4
    return folder


@pytest.fixture
def data(drives, tmp_path):
    (tmp_path / "episodes").symlink_to(drives / "episodes")
    return tmp_path


def train(data, config=SHORT, report=ignore, **more):
    return train_vae.train_vae(data, config, report, LAYERS, **more)


def test_a_vae_that_is_worse_than_the_mean_picture_logs_a_warning(data, caplog):
    figures = train(data)
    assert figures["reconstruction_error"] > figures["mean_picture_error"]
    assert "--updates" in caplog.text


def test_a_training_goes_on_by_the_seed_that_it_was_begun_with(data):
    train(data)
    with pytest.raises(UsageError, match=r"--seed 0.*--seed 3.*--seed 0"):
        train(data, replace(SHORT, updates=8, seed=3))
    assert load_progress(data / "vae.safetensors")["update"] == 6
    train(data, replace(SHORT, seed=3), new=True)
    assert load_progress(data / "vae.safetensors")["seed"] == 3


def call(*words):
    return run_verb(verb, "vae", *words, *FLAGS)


def state(path):
    return {name: array.tobytes() for name, array in load_weights(path).items()}, load_progress(path)


def files(folder, stem="vae"):
    return {path.name: state(path) for path in folder.glob(f"{stem}.*safetensors")}


def made(folder):
    return sorted(path.name for path in folder.iterdir() if path.name != "episodes")


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

        return write

    def run(folder):
        train_mdnrnn.train_mdnrnn(folder, config, ignore, RNN)

    def begin(name):
        folder = tmp_path / name
        folder.mkdir()
        for each in ("encoded", train_vae.CHECKPOINT):
            (folder / each).symlink_to(drives / each)
        return folder

    monkeypatch.setattr(training_state, "save_checkpoint", killed_at(0))
    run(whole := begin("whole"))
    expected = files(whole, "mdnrnn")
    assert (expected["mdnrnn.safetensors"][1].get("stopped") is not None) == (rate == 1e-12)
    for number in range(1, len(writes) + 1):
        folder = begin(f"{number}")
        writes.clear()
        monkeypatch.setattr(training_state, "save_checkpoint", killed_at(number))
        with pytest.raises(KilledError):
            run(folder)
        run(folder)
        assert files(folder, "mdnrnn") == expected


def test_a_full_disk_is_one_line_and_the_last_checkpoint_stays(drives, data):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(done, _note):
        if done == 3:
            resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))

    try:
        with pytest.raises(DatasetError, match=r"vae\.safetensors"):
            train(data, report=fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert load_progress(data / train_vae.CHECKPOINT)["update"] == 2
    assert made(data) == ["vae.jsonl", "vae.safetensors"]
    train(data)
    assert state(data / train_vae.CHECKPOINT) == state(drives / train_vae.CHECKPOINT)


def test_a_point_of_the_curve_is_whole_or_not_there(tmp_path):
    path, (soft, hard) = tmp_path / "vae.jsonl", resource.getrlimit(resource.RLIMIT_FSIZE)
    append_point(path, update=20, error=1.0)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 5, hard))
    try:
        with pytest.raises(DatasetError):
            append_point(path, update=40, error=1.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
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
        call("--data", data, "--updates", 1)
    with folder_lock(data / "mdnrnn.lock", "other"):
        assert call("--data", data, "--updates", 1) == 0


def test_a_training_without_data_makes_no_folder(tmp_path):
    with pytest.raises(DatasetError, match="missing"):
        call("--data", tmp_path / "missing", "--updates", 1)
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
    words = ("--data", data, "--updates", 20, "--rate", 1e-12, "--set", "validate_every=1", "patience=2")
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
    train(data, still)
    (data / "vae.best.safetensors").write_bytes(b"of another training, and damaged")
    train(data, replace(still, updates=20, patience=1))
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
    assert call("--data", data, "--updates", 1, "--new", "--seed", 3) == 0
    assert load_progress(data / train_vae.CHECKPOINT)["update"] == 1


def test_new_begins_from_a_kept_checkpoint_and_never_from_what_it_replaces(data):
    train(data, replace(SHORT, keep_every=2))
    last, kept = data / train_vae.CHECKPOINT, numbered_path(data / train_vae.CHECKPOINT, 4)
    before = last.read_bytes()
    with pytest.raises(UsageError, match=r"--new.*--continue-from"):
        train(data, continue_from=data / "." / last.name, new=True)
    with pytest.raises(UsageError, match=r"--decoder-only.*--continue-from"):
        train(data, decoder_only=True, new=True)
    assert last.read_bytes() == before
    train(data, replace(SHORT, updates=1, rate=1e-12), continue_from=kept, new=True)
    one, other = load_weights(kept), load_weights(last)
    assert all(np.allclose(one[name], other[name], atol=1e-9) for name in one)
    assert made(data) == ["vae.000004.safetensors", "vae.jsonl", "vae.safetensors"]


def test_a_stop_of_a_new_training_says_how_to_go_on(data):
    train(data)
    with pytest.raises(StoppedError, match="--new"):
        train(data, new=True, stop=lambda: True)
    assert load_progress(data / train_vae.CHECKPOINT)["update"] == 0
