"""Verbs that work for long, and Ctrl-C or SIGTERM: what is there is kept and named, and the exit code says so."""

import os
import signal

import av
import pytest

from dreamfleet.worker.training.checkpoint import load_progress
from dreamfleet.worker.training.data.dataset import existing_episodes
from tests.support.drives import write_drives


@pytest.fixture(params=[signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)])
def number(request):
    return request.param


def stopped(process, number, there):
    """Send the signal to the whole group, as a terminal does, once something is `there`; what it said last."""
    while not there():
        assert process.popen.poll() is None, "".join(process.lines)
    os.killpg(process.popen.pid, number)
    code, _ = process.finish()
    assert code == 130
    assert "Traceback" not in "".join(process.lines)
    return process.lines[-1]


@pytest.mark.slow
def test_training_keeps_all_updates(processes, tmp_path, number):
    write_drives(tmp_path, episodes=4, steps=8)
    curve = tmp_path / "vae.jsonl"
    flags = ("--updates", 100_000, "--batch", 8, "--set", "channels=2,2,4,4", "validate_every=100000")
    training = processes.start("train", "vae", "--data", tmp_path, *flags)
    said = stopped(training, number, lambda: curve.exists() and curve.read_text().count("update") >= 2)
    update = load_progress(tmp_path / "vae.safetensors")["update"]
    assert update >= 40
    assert all(datum in said for datum in (f" {update} ", "100000", f"{tmp_path}/vae.safetensors"))


@pytest.mark.slow
def test_a_recording_can_be_played(processes, tmp_path, number):
    out = tmp_path / "drive.mp4"
    recording = processes.start("record", "--controller", "tiny", "--out", out)
    said = stopped(
        recording, number, lambda: any(each.is_file() and each.stat().st_size for each in tmp_path.rglob("*"))
    )
    with av.open(str(out)) as container:
        frames = len(list(container.decode(container.streams.video[0])))
    assert 0 < frames < 1000
    assert all(datum in said for datum in (str(out), f" {frames} "))


@pytest.mark.slow
def test_a_collection_keeps_its_episodes_and_counts_them(processes, tmp_path, number):
    flags = ("--episodes", 1000, "--jobs", 2)
    collecting = processes.start("collect", "--data", tmp_path, *flags)
    said = stopped(collecting, number, lambda: len(existing_episodes(tmp_path)) >= 2)
    kept = len(existing_episodes(tmp_path))
    assert all(datum in said for datum in (str(tmp_path), f" {kept} ", "1000"))
    assert [path.name for path in (tmp_path / "episodes").iterdir() if path not in existing_episodes(tmp_path)] == []
