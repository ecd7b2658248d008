"""The wheel by the tool `uv`: one for all versions of Python, which films a drive."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent

pytestmark = [pytest.mark.long, pytest.mark.timeout(1800)]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "build", "--wheel", "--outdir", folder, ROOT)
    (found,) = folder.glob("dreamfleet-*-cp311-abi3-linux_*.whl")
    return found


def run(*words):
    subprocess.run([str(each) for each in words], cwd=BIN, check=True)  # where `dreamfleet` is no folder


def test_uv_installs_it(wheel, tmp_path):
    run(BIN / "uv", "venv", "--python", sys.executable, tmp_path / "venv")
    python = tmp_path / "venv/bin/python"
    run(BIN / "uv", "pip", "install", "--python", python, "--constraint", ROOT / "constraints.txt", f"{wheel}[worker]")
    run(python, "-m", "dreamfleet", "doctor", "--role", "worker")


def test_uvx_films_a_drive(wheel, tmp_path):
    video = tmp_path / "drive.mp4"
    run(BIN / "uvx", "--python", sys.executable, "--from", f"dreamfleet[worker,views] @ file://{wheel}", "dreamfleet",
        "record", "--controller", "real", "--out", video)  # fmt: skip
    assert video.stat().st_size > 10_000
