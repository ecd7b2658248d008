"""A stand-in for the package vizdoom: its game is a child process that sleeps, and three files in /dev/shm.

Like the real one it writes into the current folder of that process, gives equal bits for equal seeds and actions, has
no picture after a death, and takes seeds of 32 bits. Who goes right at each tic never dies.
"""

import secrets
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np

SHARED = tuple(Path("/dev/shm", name) for name in ("ViZDoomSM", "ViZDoomMQCtr", "ViZDoomMQDoom"))
scenarios_path = str(Path(__file__).parent)
ScreenResolution = SimpleNamespace(RES_160X120=(120, 160), RES_640X480=(480, 640))
GameVariable = SimpleNamespace(POSITION_Y="POSITION_Y")
ScreenFormat = SimpleNamespace(RGB24="RGB24")
SET = {
    "set_doom_skill": [4], "set_living_reward": [1], "set_window_visible": [False], "set_render_hud": [False, True],
    "set_screen_format": [ScreenFormat.RGB24], "set_render_screen_flashes": [False, True],
    "set_labels_buffer_enabled": [False, True],
}  # fmt: skip


class CrashError(Exception):
    pass


class DoomGame:
    _process = None

    def load_config(self, path):
        assert Path(path).name == "take_cover.cfg"

    def __getattr__(self, name):
        """A setter that takes one value alone."""
        expected = SET[name]

        def check(value):
            assert value in expected

        return check

    def set_screen_resolution(self, size):
        self._size = size

    def set_vizdoom_path(self, path):
        self._path = path

    def set_doom_config_path(self, path):
        self._config = path

    def init(self):
        name = secrets.token_hex(5)
        for path in SHARED:
            Path(f"{path}{name}").write_bytes(b"x")
        words = [self._path, "-config", self._config, "+viz_instance_id", name]
        self._process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        if self._process.stdout.readline() != "up\n":
            self.close()
            raise CrashError("ViZDoom exited unexpectedly")

    def is_running(self):
        return self._process is not None and self._process.poll() is None

    def set_seed(self, seed):
        if not 0 <= seed < 2**32:
            raise TypeError("set_seed(): incompatible function arguments")
        self._seed = seed

    def new_episode(self):
        self._tic, self._moves, self._side = 0, 0, 384.0
        self._last = 40 + self._seed % 50

    def get_state(self):
        if self.is_episode_finished():
            return None
        random = np.random.default_rng([self._seed, self._tic, self._moves])
        screen = random.integers(0, 256, (*self._size, 3), dtype=np.uint8)
        labels = np.zeros(self._size, np.uint8)
        labels[self._seed % 100 : self._seed % 100 + 20, :9], labels[:, 20] = 3, 4
        names = [SimpleNamespace(value=3, object_name="DoomImpBall"), SimpleNamespace(value=4, object_name="DoomImp")]
        return SimpleNamespace(screen_buffer=screen, labels_buffer=labels, labels=names)

    def make_action(self, buttons, tics):
        if not self.is_running():
            raise CrashError("Unexpected ViZDoom instance crash.")
        lived = 0
        while lived < tics and not self.is_episode_finished():
            lived += 1
            self._tic += 1
            self._moves = self._moves * 3 % 2**31 + buttons[0] + 2 * buttons[1]
            self._last += buttons[1]
            self._side = min(max(self._side + 8 * (buttons[0] - buttons[1]), 16.0), 752.0)
        return float(lived)

    def get_game_variable(self, name):
        assert name == GameVariable.POSITION_Y
        return self._side

    def is_episode_finished(self):
        return self._tic >= self._last

    def close(self):
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process.stdout.close()
            self._process = None
