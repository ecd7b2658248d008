"""ViZDoom in tests: the real package or a stand-in, what a game's process is, and what it leaves behind."""

import hashlib
import importlib.util
import os
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
import pytest

from dreamfleet.worker.worlds.takecover.game import TakeCover
from dreamfleet.worker.worlds.takecover.process import GAME_NAME_FLAG, SHARED_FILES
from tests.support.processes import ROOT

FAKE = Path(__file__).parent / "fake_vizdoom"
REAL_IS_HERE = importlib.util.find_spec("vizdoom") is not None
SHARED_MEMORY = Path("/dev/shm")


def require_doom():
    if not REAL_IS_HERE:
        pytest.skip("not installed: vizdoom (make test-doom)")


def use_fake(monkeypatch):
    """Let `import vizdoom` find the stand-in, in this process and in those that multiprocessing spawns."""
    spec = importlib.util.spec_from_file_location("vizdoom", FAKE / "vizdoom" / "__init__.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setitem(sys.modules, "vizdoom", module)
    monkeypatch.syspath_prepend(FAKE)


def search_path():
    """`PYTHONPATH` for processes that find the same vizdoom as this one."""
    return os.pathsep.join([str(FAKE), str(ROOT)] if str(FAKE) in sys.path else [str(ROOT)])


def games(parent):
    """Ids of the running processes of games with this parent."""
    found = set()
    for each in psutil.Process(parent).children():
        with suppress(psutil.NoSuchProcess, psutil.ZombieProcess):  # it has ended
            if GAME_NAME_FLAG in each.cmdline():
                found.add(each.pid)
    return found


def name_of_game(process):
    words = Path(f"/proc/{process}/cmdline").read_text().split("\0")
    return words[words.index(GAME_NAME_FLAG) + 1]


def shared_files(name):
    """The files in /dev/shm of the game of this name."""
    return [path for each in SHARED_FILES if (path := SHARED_MEMORY / f"{each}{name}").exists()]


def play(seeds, tics=4):
    """A digest of all pictures and rewards of episodes under random actions."""
    digest, game = hashlib.sha256(), TakeCover(tics)
    for seed in seeds:
        random, over = np.random.default_rng(seed), False
        digest.update(game.reset(seed=seed)[0].tobytes())
        while not over:
            picture, reward, terminated, truncated, _ = game.step(int(random.integers(3)))
            digest.update(picture.tobytes() + np.float64(reward).tobytes())
            over = terminated or truncated
    game.close()
    return digest.hexdigest()
