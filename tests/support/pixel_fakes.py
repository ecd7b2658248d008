"""Environments of pictures, each with something that world models must get along with; all are dodged as `Dodge` is."""

import os
import signal
import subprocess
import sys
from threading import Event
from typing import ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from tests.support.pixel_world import HEIGHT, WIDTH, Dodge

MODULE = "tests.support.pixel_fakes"
HAND = spaces.Discrete(3, start=5)
SWITCHES = spaces.Tuple((spaces.MultiDiscrete([2]), spaces.MultiBinary(2)))


class Observing(Dodge):
    """Observes what `observe` makes of the picture."""

    def reset(self, *, seed=None, options=None):
        picture, info = super().reset(seed=seed, options=options)
        return self.observe(picture), info

    def step(self, action):
        picture, *rest = super().step(action)
        return (self.observe(picture), *rest)


class InDict(Observing):
    """Observes a Dict of a picture and a number."""

    observation_space = spaces.Dict({"screen": Dodge.observation_space, "speed": spaces.Box(-1, 1, (1,), np.float32)})

    def observe(self, picture):
        return {"screen": picture, "speed": np.zeros(1, np.float32)}


class InTwo(InDict):
    observation_space = spaces.Dict({"screen": Dodge.observation_space, "map": Dodge.observation_space})

    def observe(self, picture):
        return {"screen": picture, "map": picture[::-1]}


class Grey(Dodge):
    """Observes `(H, W)`."""

    observation_space = spaces.Box(0, 255, (HEIGHT, WIDTH), np.uint8)

    def render(self):
        return super().render()[..., 0]


class ChannelsFirst(Observing):
    """Observes `(3, H, W)`, and draws floats from 0 to 1 with opacity."""

    observation_space = spaces.Box(0, 255, (3, HEIGHT, WIDTH), np.uint8)

    def observe(self, picture):
        return np.moveaxis(np.rint(picture[..., :3] * 255).astype(np.uint8), -1, 0)

    def render(self):
        return np.dstack([super().render() / 255, np.full((HEIGHT, WIDTH), 0.5)])


class Stacked(ChannelsFirst):
    """Observes its last four pictures, grey."""

    observation_space = spaces.Box(0, 1, (4, HEIGHT, WIDTH), np.float32)

    def reset(self, *, seed=None, options=None):
        self.seen = np.zeros((4, HEIGHT, WIDTH), np.float32)
        return super().reset(seed=seed, options=options)

    def observe(self, picture):
        self.seen = np.float32([*self.seen[1:], picture[..., 0]])
        return self.seen


class Reporting(Dodge):
    """Reports the action that it gets."""

    def step(self, action):
        assert action in self.action_space
        *moment, info = super().step(self.move(action))
        return (*moment, {**info, "taken": action})


class Floats(Reporting):
    """Observes floats from 0 to 1, and takes a flat Box: below -1/3 is left, above 1/3 right."""

    observation_space = spaces.Box(0, 1, (HEIGHT, WIDTH, 3), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def move(self, action):
        return 1 if action[0] < -1 / 3 else 2 if action[0] > 1 / 3 else 0

    def render(self):
        return super().render().astype(np.float32) / np.float32(255)


class Buttons(Reporting):
    """Takes MultiDiscrete actions: a move that counts from 1, and a button that does nothing."""

    action_space = spaces.MultiDiscrete([3, 2], start=[1, 0])

    def move(self, action):
        return action[0] - 1


class Switches(Reporting):
    """Takes MultiBinary actions: left and right, which cancel each other."""

    action_space = spaces.MultiBinary(2)

    def move(self, action):
        return {(1, 0): 1, (0, 1): 2}.get(tuple(action.tolist()), 0)


class BothEnds(Dodge):
    """Its own limit of 25 steps sets both flags, as ViZDoom's does; its seeds have 32 bits."""

    def reset(self, *, seed=None, options=None):
        if seed is not None and seed >= 2**32:
            raise TypeError("a seed has 32 bits")
        self.steps = 0
        return super().reset(seed=seed, options=options)

    def step(self, action):
        picture, reward, dead, _, info = super().step(action)
        self.steps += 1
        return picture, reward, dead or self.steps >= 25, self.steps >= 25, info


class Unseen(Observing):
    """Observes numbers, and draws pictures."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)

    def observe(self, picture):
        return np.float32([self._player / WIDTH, self._row / HEIGHT])


class Single(Unseen):
    """Refuses a second instance while one is open, as many simulators do."""

    is_open = False

    def __init__(self, render_mode=None):
        super().__init__(render_mode)
        if Single.is_open:
            raise RuntimeError("another one is open")
        Single.is_open = True

    def close(self):
        Single.is_open = False


class Shared(Unseen):
    """Its `close` shuts what all instances share."""

    def __init__(self, render_mode=None):
        super().__init__(render_mode)
        Shared.is_on = True

    def step(self, action):
        if not Shared.is_on:
            raise RuntimeError("the simulator is off")
        return super().step(action)

    def close(self):
        Shared.is_on = False


class Board(Unseen):
    """Observes a table of codes."""

    observation_space = spaces.Box(0, 9, (24, 18), np.uint8)

    def observe(self, picture):
        return np.zeros((24, 18), np.uint8)


class Gauges(gymnasium.Env):
    """No pictures: observes a Dict of numbers of all kinds, and takes a Dict of numbered actions."""

    observation_space = spaces.Dict(
        {"switches": SWITCHES, "speeds": spaces.Box(-1, 1, (2, 1), np.float32), "hand": HAND}
    )
    action_space = spaces.Dict({"lamps": spaces.MultiBinary(1), "gear": spaces.Discrete(2, start=1)})

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.observe(), {}

    def step(self, action):
        assert action in self.action_space
        self.steps += 1
        return self.observe(), float(action["gear"] + action["lamps"][0]), self.steps == 5, False, {"taken": action}

    def observe(self):
        switches = np.array([1]), np.array([0, 1], np.int8)
        return {"switches": switches, "speeds": np.float32([[0.5], [0.25]]), "hand": np.int64(7)}


class Telling(Gauges):
    """Observes texts among numbers, as MiniGrid does, and deeper ones too."""

    notes = spaces.Tuple((spaces.Text(3), spaces.Box(-1, 1, (2,), np.float32)))
    observation_space = spaces.Dict({"hand": HAND, "mission": spaces.Text(9), "notes": notes})

    def observe(self):
        return {"hand": np.int64(7), "mission": "go", "notes": ("so", np.float32([0.5, 0.25]))}


class Mute(Gauges):
    """Observes only a text."""

    observation_space = spaces.Dict({"mission": spaces.Text(9)})


class Blind(Gauges):
    observation_space = spaces.Box(-1, 1, (0,), np.float32)


class Faulty(Dodge):
    """Its third step has a fault."""

    def __init__(self, render_mode=None, fault=""):
        super().__init__(render_mode)
        self.fault = fault

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return super().reset(seed=seed, options=options)

    def step(self, action):
        picture, reward, *rest = super().step(action)
        self.steps += 1
        if self.steps == 3:
            if self.fault == "raises":
                raise RuntimeError("a broken simulator\nwith details")
            if self.fault == "exits":
                sys.exit(0)
            if self.fault == "hangs":
                Event().wait()
            reward = float(self.fault)
        return (picture, reward, *rest)


class Rude(Dodge):
    """As it is made it does to its process what it should not; `close` and what it says of itself fail too."""

    metadata: ClassVar = {**Dodge.metadata, "render_fps": "fast"}

    def __init__(self, render_mode=None, close="raises", child=""):
        super().__init__(render_mode)
        self.at_close = close
        self.misbehave()
        if child:
            script = "import pathlib, signal, sys, os, time\n"
            script += "for each in (signal.SIGINT, signal.SIGTERM): signal.signal(each, signal.SIG_IGN)\n"
            script += "open(sys.argv[1], 'a').write(f'{os.getpid()}\\n')\nwhile True: time.sleep(60)"
            subprocess.Popen([sys.executable, "-c", script, child], start_new_session=True)

    def misbehave(self):
        os.chdir("/")
        print("made")  # noqa: T201
        os.write(1, b"made\n")
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)

    def reset(self, *, seed=None, options=None):
        self.misbehave()
        return super().reset(seed=seed, options=options)

    def get_action_meanings(self):
        return ["stay", "\x1b[2J", 5]

    def close(self):
        self.misbehave()
        if self.at_close == "exits":
            sys.exit(0)
        raise RuntimeError("closing is broken\nwith details")


KINDS = (
    Faulty, Rude, InDict, InTwo, Grey, ChannelsFirst, Stacked, Floats, Buttons, Switches, BothEnds, Unseen, Board,
    Gauges, Telling, Mute, Blind, Single, Shared,
)  # fmt: skip
for each in KINDS:
    gymnasium.register(f"{each.__name__}-v0", each, max_episode_steps=200)
