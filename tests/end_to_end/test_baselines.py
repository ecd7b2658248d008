"""A baseline's training as a process that is interrupted and killed."""

import os
import signal

import pytest

from dreamfleet.worker.addons.baselines.presets import find_preset
from dreamfleet.worker.addons.baselines.train import CHECKPOINT, CURVE, train_drqn
from dreamfleet.worker.training.checkpoint import load_progress, load_weights
from dreamfleet.worker.training.config_flags import override

EPISODES, TUPLES = 12, ("channels", "kernels", "strides")
SETTINGS = {
    "channels": 2, "kernels": 8, "strides": 8, "hidden": 4, "steps": 60, "random_episodes": 2, "batch": 2,
    "learn_every": 2, "report_every": 1, "replay": 100, "episodes": EPISODES,
}  # fmt: skip
FLAGS = ("steps", "episodes")


def finish(folder):
    """Train to the end, here."""
    values = {name: (value,) if name in TUPLES else value for name, value in SETTINGS.items()}
    preset = find_preset("learning")
    train_drqn(folder, override(preset.agent, values), override(preset.learning, values))


def state(folder):
    weights = {name: array.tobytes() for name, array in load_weights(folder / CHECKPOINT).items()}
    kept = {path.name: path.read_bytes() for path in (folder / "replay").iterdir()}
    return weights, load_progress(folder / CHECKPOINT), (folder / CURVE).read_bytes(), kept


@pytest.mark.slow
def test_a_training_that_was_interrupted_and_killed_goes_on_to_the_same_bits(processes, tmp_path):
    settings = (f"{name}={value}" for name, value in SETTINGS.items() if name not in FLAGS)
    flags = (word for name in FLAGS for word in (f"--{name}", SETTINGS[name]))
    words = ("baseline", "train", "drqn", "--data", tmp_path / "broken", *flags, "--set", *settings)
    first = processes.start(*words)
    first.wait_for("episode 3:")
    os.killpg(first.popen.pid, signal.SIGINT)
    assert first.finish()[0] == 130, "".join(first.lines)
    assert "drqn.safetensors" in first.lines[-1]
    second = processes.start(*words)
    second.wait_for("episode 6:")
    os.killpg(second.popen.pid, signal.SIGKILL)
    assert second.finish()[0] == -signal.SIGKILL
    assert 6 <= len(load_progress(tmp_path / "broken" / CHECKPOINT)["episodes"]) < EPISODES
    finish(tmp_path / "broken")
    finish(tmp_path / "whole")
    assert state(tmp_path / "broken") == state(tmp_path / "whole")
