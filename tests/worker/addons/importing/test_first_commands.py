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

# What is typed, its exit code, and the command that the answer names, or "" where it is the result.
FROM_WME = [
    ("evaluate --controller log/best.json", 1, "import log/best.json --bundle WORLD_MODEL --out controller.npz"),
    ("record --controller log/best.json --out x.mp4", 1,
     "import log/best.json --bundle WORLD_MODEL --out controller.npz"),
    ("coordinator --run x --init log/best.json", 1, "import log/best.json --bundle WORLD_MODEL --out controller.npz"),
    ("lab refit log/best.json --to tiny --data data --out x.npz", 1,
     "import log/best.json --bundle WORLD_MODEL --out controller.npz"),
    ("import log/best.json --out x.npz", 2, "import FOLDER --out world.zip"),
    ("import log/best.json --bundle world.zip --out x.npz", 0, ""),
    ("train vae --data record", 1, "import record --out DATA"),
    ("import record --out data", 0, "train vae --data data --preset paper"),
]  # fmt: skip
FROM_THE_ARTICLE = [
    ("evaluate --controller controller/car_racing.cma.4.32.best.json", 1,
     "import controller/car_racing.cma.4.32.best.json --bundle WORLD_MODEL --out controller.npz"),
    ("import controller/car_racing.cma.4.32.best.json --layout article --bundle world.zip --out x.npz", 0, ""),
    ("train vae --data rollout", 1, "import rollout --out DATA"),
    ("import rollout --out data", 0, "train vae --data data --preset paper"),
    ("import vae/weights.h5 --out x.zip", 1, "import DRIVES --out DATA"),
    ("import . --out x.zip", 1, "import DRIVES --out DATA"),
]  # fmt: skip
FROM_CTALLEC = [
    ("evaluate --controller exp_dir/ctrl/best.tar", 1,
     "import exp_dir/ctrl/best.tar --bundle WORLD_MODEL --out controller.npz"),
    ("coordinator --run x --init exp_dir/ctrl/best.tar", 1,
     "import exp_dir/ctrl/best.tar --bundle WORLD_MODEL --out controller.npz"),
    ("evaluate --controller exp_dir", 1, "import exp_dir --out OUT"),
    ("evaluate --controller tiny --bundle exp_dir/vae/best.tar", 1, "import exp_dir --out world.zip"),
    ("import exp_dir/ctrl/best.tar --out x.npz", 2, "import exp_dir --out world.zip"),
    ("import exp_dir/vae/best.tar --out x.zip", 1, "import exp_dir --out world.zip"),
    ("coordinator --run x --task dream --bundle exp_dir", 1, "import exp_dir --out world.zip"),
    ("import exp_dir --out world.zip", 0, "import exp_dir/ctrl/best.tar --bundle world.zip --out controller.npz"),
    ("import exp_dir/ctrl/best.tar --bundle world.zip --out x.npz", 0,
     "evaluate --controller x.npz --bundle world.zip"),
    ("import exp_dir/ctrl --bundle world.zip --out x.npz", 0, "evaluate --controller x.npz --bundle world.zip"),
    ("train vae --data datasets/carracing", 1, "import datasets/carracing --out DATA"),
    ("import datasets/carracing --out data", 0, "train vae --data data --preset paper"),
]  # fmt: skip


@pytest.fixture(scope="module")
def theirs(tmp_path_factory):
    """A folder with the files that the three programs write, and a world model `world.zip`."""
    folder = tmp_path_factory.mktemp("theirs")
    checkpoint_files.write_checkpoints(folder / "exp_dir", checkpoint_files.random_weights())
    assert main(["import", str(folder / "exp_dir"), "--out", str(folder / "world.zip")]) == 0
    for place in ("log/best.json", "controller/car_racing.cma.4.32.best.json"):
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


@pytest.mark.parametrize(("typed", "code", "named"), [*FROM_WME, *FROM_THE_ARTICLE, *FROM_CTALLEC])
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


def test_no_file_of_the_source_is_replaced(theirs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(theirs)
    before = (theirs / "exp_dir/vae/best.tar").read_bytes()
    assert main(["import", "exp_dir", "--out", "exp_dir/vae/best.tar"]) == 2
    assert main(["import", "exp_dir/ctrl/best.tar", "--bundle", "world.zip", "--out", "exp_dir/ctrl/best.tar"]) == 2
    assert "exp_dir/ctrl/best.tar" in capsys.readouterr().err
    assert (theirs / "exp_dir/vae/best.tar").read_bytes() == before
