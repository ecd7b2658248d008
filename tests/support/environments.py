"""gym:tests.support.environments:Odd-v0: an environment with one fault, which its argument `fault` names.

Strict-v0 beside it refuses each action outside of its space."""

import os
import random
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium import spaces

ODD = "gym:tests.support.environments:Odd-v0"
DAEMON_FILE = "DAEMON_FILE"  # an environment variable


def _leave_daemon():
    """A process that leaves the session and keeps all pipes; its id goes to the file that `DAEMON_FILE` names."""
    reads, writes = os.pipe()
    if os.fork() == 0:
        os.setsid()
        Path(os.environ[DAEMON_FILE]).write_text(str(os.getpid()))
        os.close(reads)
        os.close(writes)
        time.sleep(3600)
        os._exit(0)
    os.close(writes)
    os.read(reads, 1)  # until the file is written
    os.close(reads)


def _leave_daemon_and_raise():
    _leave_daemon()
    raise RuntimeError("no licence")


def _leave_daemon_and_hang():
    _leave_daemon()
    time.sleep(3600)


def _close_and_hang():
    os.closerange(3, 256)
    time.sleep(3600)


def _write_to_all(text, times=1):
    for descriptor in range(3, 64):
        with suppress(OSError):
            for _ in range(times):
                os.write(descriptor, text)


def _print_without_end():
    while True:
        os.write(2, b"x" * 65_536)


_DEEDS = {
    "daemon": _leave_daemon,
    "daemon and raise": _leave_daemon_and_raise,
    "daemon and hang": _leave_daemon_and_hang,
    "close and hang": _close_and_hang,
    "big line": lambda: _write_to_all(b"z" * 65_536, 1000),
    "line": lambda: _write_to_all(b"zzz\n"),
    "bytes": lambda: _write_to_all(b"\xff\xfe\n"),
    "nested": lambda: _write_to_all(b'{"report":' + b"[" * 50_000 + b"\n"),
    "null report": lambda: _write_to_all(b'{"report": {"description": 5}}\n'),
    "steps": lambda: _write_to_all(b'{"step": "another"}\n', 1000),
    "exit in peace": lambda: os._exit(0),
    "flood": _print_without_end,
}  # what an environment does as it is made


class Odd(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-10, 10, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, fault="", render_mode=None):
        self._fault = fault
        self._steps = 0  # of all episodes
        self.env = sys  # some keep their simulator here; it is no environment
        if fault == "noisy":
            print("a simulator greets")  # noqa: T201
        if fault in _DEEDS:
            _DEEDS[fault]()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if self._fault == "bits" and seed is not None and seed >= 2**32:
            raise ValueError("Seed must be between 0 and 2**32 - 1")
        if self._fault == "exit":
            sys.exit(3)
        if self._fault == "exit at once":
            os._exit(3)
        if self._fault == "crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        if self._fault == "hang":
            time.sleep(3600)
        if self._fault == "checker" and seed == 123:  # gymnasium's checker alone resets so
            os._exit(4)
        if self._fault == "checker in peace" and seed == 123:
            os._exit(0)
        at = self.np_random.uniform(-1, 1, 2)
        self._at = {"random": np.random.uniform(-1, 1, 2), "nan": np.full(2, np.nan), "outside": np.full(2, 99.0)}.get(  # noqa: NPY002
            self._fault, at
        )
        answer = self._at.astype(np.float32)
        return answer if self._fault == "old reset" else (answer, {})

    def step(self, action):
        self._steps += 1
        self._at = 0.9 * self._at + (0.1 if action else -0.1)
        self._at += {
            "noise": random.random(),
            "carry": 0.01 * self._steps,
            "hash": "lr".index(min({"left", "right"}, key=lambda _: 0)[0]),
        }.get(self._fault, 0)
        if self._fault == "raise":
            raise RuntimeError("the engine\nstalled")
        reward = float(-np.abs(self._at).sum())
        reward = {"array": np.zeros(2), "infinite": np.inf, "none": None}.get(self._fault, reward)
        answer = self._at.astype(np.float32), reward, False
        return (*answer, {}) if self._fault == "old step" else (*answer, False, {})


gymnasium.register("Odd-v0", Odd, max_episode_steps=20)
gymnasium.register("OddEndless-v0", Odd)


STRICT = "tests.support.environments:Strict-v0"
ACTIONS = {
    "float64": spaces.Box(-0.1, 0.1, (2,), np.float64),  # float32(0.1) > 0.1
    "float32": spaces.Box(-0.1, 0.1, (2,), np.float32),
    "float16": spaces.Box(-0.1, 0.7, (2,), np.float16),
    "square": spaces.Box(-0.1, 0.1, (2, 1), np.float64),
    "bytes": spaces.Box(0, 255, (2,), np.uint8),
    "signed": spaces.Box(np.array([-3, 0]), np.array([3, 10**9]), dtype=np.int64),
    "mixed": spaces.Dict({"turn": spaces.Box(-0.3, 0.3, (1,), np.float64), "gear": spaces.Box(1, 6, (1,), np.int8)}),
    "start": spaces.Discrete(3, start=-7),
    "many": spaces.MultiDiscrete([11, 11, 11]),
    "large": spaces.Discrete(4096, start=1),
    "endless": spaces.Box(np.iinfo(np.int64).min, np.iinfo(np.int64).max, (1,), np.int64),
}


class Strict(gymnasium.Env):
    """Its argument `actions` names its action space; `breaks` is an action that it has, but cannot take."""

    observation_space = spaces.Box(-1, 1, (1,), np.float64)

    def __init__(self, actions="float64", breaks=None, huge=False):
        self.action_space, self.breaks, self.huge = ACTIONS[actions], breaks, huge

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.array([1e39 if self.huge else 0.5]), {}

    def step(self, action):
        assert action in self.action_space
        if self.breaks is not None and np.all(action == self.breaks):
            raise RuntimeError("too much")
        return np.array([1e39 if self.huge else 0.5]), 1.0, False, False, {"taken": action}


gymnasium.register("Strict-v0", Strict, max_episode_steps=20)
