"""What people who come from another project type first: it works, or the answer names the command that does it.
Tests sources.py and verb.py."""

import json
import re
import shlex

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.cli.command_line import main
from tests.support import checkpoint_files
from tests.support.foreign_drives import ctallec_drive

WME, ARTICLE, CTALLEC = "log/best.json", "controller/car_racing.cma.4.32.best.json", "exp_dir/ctrl/best.tar"
DRIVES = ("record", "rollout", "datasets/carracing")
TRAIN = "train vae --data data --preset paper"
# What is typed, its exit code, and the command that the answer names, or "" where it is the result.
TYPED = [
    *((typed.format(source), 1, f"import {source} --bundle WORLD_MODEL --out controller.npz") for source, typed in (
        *((source, "evaluate --controller {}") for source in (WME, ARTICLE, CTALLEC)),
        (WME, "record --controller {} --out x.mp4"),
        (WME, "coordinator --run x --init {}"),
        (CTALLEC, "coordinator --run x --init {}"),
        (WME, "lab refit {} --to tiny --data data --out x.npz"),
    )),
    *((f"train vae --data {source}", 1, f"import {source} --out DATA") for source in DRIVES),
    *((f"import {source} --out data", 0, TRAIN) for source in DRIVES),
    (f"import {WME} --out x.npz", 2, "import FOLDER --out world.zip"),
    (f"import {WME} --bundle world.zip --out x.npz", 0, ""),
    (f"import {ARTICLE} --layout article --bundle world.zip --out x.npz", 0, ""),
    ("import vae/weights.h5 --out x.zip", 1, "import DRIVES --out DATA"),
    ("import . --out x.zip", 1, "import DRIVES --out DATA"),
    ("evaluate --controller exp_dir", 1, "import exp_dir --out OUT"),
    ("evaluate --controller tiny --bundle exp_dir/vae/best.tar", 1, "import exp_dir --out world.zip"),
    (f"import {CTALLEC} --out x.npz", 2, "import exp_dir --out world.zip"),
    ("import exp_dir/vae/best.tar --out x.zip", 1, "import exp_dir --out world.zip"),
    ("coordinator --run x --task dream --bundle exp_dir", 1, "import exp_dir --out world.zip"),
    ("import exp_dir --out world.zip", 0, f"import {CTALLEC} --bundle world.zip --out controller.npz"),
    (f"import {CTALLEC} --bundle world.zip --out x.npz", 0, "evaluate --controller x.npz --bundle world.zip"),
    ("import exp_dir/ctrl --bundle world.zip --out x.npz", 0, "evaluate --controller x.npz --bundle world.zip"),
]  # fmt: skip


@pytest.fixture(scope="module")
def theirs(tmp_path_factory):
    """A folder with the files that the three programs write, and a world model `world.zip`."""
    folder = tmp_path_factory.mktemp("theirs")
    checkpoint_files.write_checkpoints(folder / "exp_dir", checkpoint_files.random_weights())
    assert main(["import", str(folder / "exp_dir"), "--out", str(folder / "world.zip")]) == 0
    for place in (WME, ARTICLE):
        (folder / place).parent.mkdir()
        (folder / place).write_text(json.dumps([np.linspace(-0.2, 0.2, 867).round(4).tolist(), 903.5]))
    pictures = np.zeros((3, 64, 64, 3), np.uint8)
    drives = {
        "record": {"obs": pictures, "action": np.zeros((3, 3), np.float16)},
        "rollout": {
            "obs": pictures / np.float32(255), "action": np.zeros((3, 3)), "reward": np.array([-0.1, 7, -0.1]),
            "done": np.zeros(3, bool),
        },
    }  # fmt: skip
    for place, arrays in drives.items():
        (folder / place).mkdir()
        for number in (1520837, 934721):
            np.savez_compressed(folder / place / f"{number}.npz", **arrays)
    for number in range(2):
        ctallec_drive(folder / "datasets" / "carracing" / f"thread_{number}", number)
    for part in ("vae", "rnn"):
        (folder / part).mkdir()
        (folder / part / "weights.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    return folder


@pytest.mark.parametrize(("typed", "code", "named"), TYPED)
def test_a_first_command_ends_in_its_result_or_names_the_command(
    typed, code, named, theirs, tmp_path, monkeypatch, capsys
):
    for path in theirs.iterdir():
        (tmp_path / path.name).symlink_to(path)
    if "--out world.zip" in typed:
        (tmp_path / "world.zip").unlink()
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(typed)) == code
    answer = "".join(capsys.readouterr())
    assert f"`dreamfleet {named}" in answer
    assert "Traceback" not in answer
    if code and not {"FOLDER", "DRIVES", "OUT"} & set(named.split()):  # what it names does it
        command = re.search(r"`dreamfleet (import [^`]*)`", answer)[1]
        assert main(shlex.split(command.replace("WORLD_MODEL", "world.zip").replace("--out world", "--out again"))) == 0
        assert written_by(command.split()[-1].replace("world", "again"), tmp_path)


def written_by(name, folder):
    """What a command wrote, opened as its next user opens it."""
    path = folder / name
    if name.endswith(".npz"):
        return Controller.load(path).shape.size == 867
    return Bundle.open(path).manifest.latent == 32 if name.endswith(".zip") else any((path / "episodes").iterdir())


def test_no_file_of_the_source_is_replaced(theirs, monkeypatch, capsys):
    monkeypatch.chdir(theirs)
    before = (theirs / "exp_dir/vae/best.tar").read_bytes()
    assert main(["import", "exp_dir", "--out", "exp_dir/vae/best.tar"]) == 2
    assert main(["import", CTALLEC, "--bundle", "world.zip", "--out", CTALLEC]) == 2
    assert CTALLEC in capsys.readouterr().err
    assert (theirs / "exp_dir/vae/best.tar").read_bytes() == before
