"""Tasks whose episodes leave processes behind, end their process, or raise what nobody expects."""

import ctypes
import errno
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

from dreamfleet.worker.tasks.api import Score
from tests.support.tasks import Masked, Misbehaving, SideBySide, Toy, ToyEnvironment

MODULE = "tests.support.rough_tasks"
FOLDER = "DREAMFLEET_TEST_LEFT"  # where processes that are left behind write their ids
HALT, EXIT = "DREAMFLEET_TEST_HALT", "DREAMFLEET_TEST_EXIT"  # the seeds with which `Halting` misbehaves
SLEEP = (
    "import os, pathlib, signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
    f"pathlib.Path(os.environ.get('{FOLDER}', '/nowhere'), str(os.getpid())).touch(); time.sleep(600)"
)


def name_of(task):
    return f"{MODULE}:{task.__name__}"


class Rough(Misbehaving):
    probe_steps = 0


class HaltingEnvironment(ToyEnvironment):
    def reset(self, *, seed=None, options=None):
        self._seed = str(seed)
        return super().reset(seed=seed, options=options)

    def step(self, action):
        if self._left < 10 and self._seed in os.environ.get(HALT, "").split(","):
            time.sleep(600)
        if self._left < 10 and self._seed in os.environ.get(EXIT, "").split(","):
            os._exit(3)
        return super().step(action)


class Halting(Toy):
    """The second step of the seeds in `$DREAMFLEET_TEST_HALT` never ends; those in `..._EXIT` end their process."""

    probe_steps, environment = 0, HaltingEnvironment


class HaltingWithOthersSight(Halting, Masked):
    """The same where another's sight is driven."""

    environment = ToyEnvironment

    def make_masked_environment(self, assignment, *, foreign):
        return HaltingEnvironment() if foreign else super().make_masked_environment(assignment, foreign=foreign)


def segfault():
    os.kill(os.getpid(), signal.SIGSEGV)


def hold_copies():
    """Copies of all descriptors, which a forked process then holds too."""
    for descriptor in range(3, 64):
        with suppress(OSError):
            os.dup(descriptor)


def linger():
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    Path(os.environ[FOLDER], str(os.getpid())).touch()
    time.sleep(600)


def wait_for_one_left():
    while not any(Path(os.environ[FOLDER]).iterdir()):
        time.sleep(0.01)


def hang():
    time.sleep(600)


class Forking(Rough):
    """A forked process holds copies of the pipe; then the child crashes."""

    end = staticmethod(segfault)

    def leave(self):
        if os.fork() == 0:
            linger()

    def misbehave(self):
        hold_copies()
        self.leave()
        wait_for_one_left()
        self.end()


class ForkingBySystemCall(Forking):
    """As a simulator in C does it, so Python's hooks do not run."""

    def leave(self):
        if ctypes.PyDLL(None).fork() == 0:
            linger()


class Daemonizing(Forking):
    """The forked process leaves the session and its parent."""

    def leave(self):
        if os.fork() == 0:
            os.setsid()
            if os.fork() == 0:
                linger()
            os._exit(0)


class Executing(Forking):
    """Starts a program with an environment of its own in a process group of its own."""

    def leave(self):
        subprocess.Popen(
            [sys.executable, "-S", "-c", SLEEP], env={FOLDER: os.environ[FOLDER]}, process_group=0, close_fds=False
        )


class ForkingAndHanging(Daemonizing):
    """The child runs on."""

    end = staticmethod(hang)


class Rubbish(Rough):
    """Begins a message on each of its descriptors that never ends, and stops itself."""

    def misbehave(self):
        for descriptor in range(3, 64):
            with suppress(OSError):
                os.write(descriptor, b"\x00\x00\x00\x7frubbish")
        os.kill(os.getpid(), signal.SIGSTOP)


class Twice(Rough):
    """Two processes go on with the episode."""

    def misbehave(self):
        if not any(Path(os.environ[FOLDER]).iterdir()):
            Path(os.environ[FOLDER], "0").touch()
            os.fork()


class Exiting(Rough):
    def misbehave(self):
        threading.Thread(target=time.sleep, args=(600,)).start()
        os._exit(0)


class Deaf(Rough):
    """Takes no notice of signals, and hangs."""

    def misbehave(self):
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, lambda *_: None)
        time.sleep(600)


class Parallel(Rough):
    """Has a process of `multiprocessing` compute, and ends it with SIGTERM, as gymnasium's `AsyncVectorEnv` does."""

    begun = False

    def misbehave(self):
        if self.begun:
            return
        self.begun = True
        for method in ("fork", "spawn"):
            process = multiprocessing.get_context(method).Process(target=time.sleep, args=(600,), daemon=True)
            process.start()
            process.terminate()
            process.join()


def leak_descriptors():
    while True:
        os.dup(0)


def starve():
    os.kill(os.getpid(), signal.SIGKILL)


def fail():
    raise RuntimeError("this process is poisoned")


POISONS = {each.__name__: each for each in (fail, leak_descriptors, segfault, hang, starve)}
POISON = "DREAMFLEET_TEST_POISON"


class Poisoned(Rough):
    """Only the first episode of a process ends well."""

    steps = 0

    def misbehave(self):
        self.steps += 1
        if self.steps > 10:
            POISONS[os.environ[POISON]]()


class WearingEnvironment(ToyEnvironment):
    steps = 0

    def step(self, action):
        self.steps += 1
        if self.steps > 10:
            fail()
        return super().step(action)


class Wearing(Toy):
    """Only the first episode of an environment ends well."""

    environment = WearingEnvironment


class SlowToBeginEnvironment(ToyEnvironment):
    def reset(self, *, seed=None, options=None):
        time.sleep(1.0)
        return super().reset(seed=seed, options=options)


class SlowToBegin(SideBySide):
    """A reset takes a second."""

    probe_steps, environment = 0, SlowToBeginEnvironment


class OnlyOne(SideBySide):
    """A process can make one environment, as with a port of its own."""

    def __init__(self):
        self._made = False

    def make_environment(self, assignment):
        if self._made:
            raise OSError(errno.EADDRINUSE, "Address already in use")
        self._made = True
        return ToyEnvironment()


class DeadlyEnvironment(ToyEnvironment):
    def reset(self, *, seed=None, options=None):
        if seed == DEADLY:
            os.kill(os.getpid(), signal.SIGSEGV)
        return super().reset(seed=seed, options=options)


class OneCrashes(Toy):
    """The episode with the seed `DEADLY` kills its process."""

    environment = DeadlyEnvironment


DEADLY = 1048576 + 2


class PoisonedBatch(Toy):
    """From the second group of a process on, the last fitness of a group is out of bounds."""

    batch_size = 4

    def make_batch(self, assignment):
        return SpoiltBatch()


class SpoiltBatch:
    groups = 0

    def score(self, episodes, on_step):
        self.groups += 1
        on_step(10 * len(episodes))
        fine = [Score(1.0, 10)] * (len(episodes) - 1)
        return [*fine, Score(1.0 if self.groups == 1 else 1e200, 10)]


class Mute(Exception):  # noqa: N818
    def __str__(self):
        raise SystemExit(7)

    __repr__ = __str__


ERRORS = {
    "SystemExit": lambda: SystemExit(3),
    "KeyboardInterrupt": KeyboardInterrupt,
    "GeneratorExit": GeneratorExit,
    "Mute": Mute,
    "ValueError": lambda: ValueError("\udc80\0é" + "x" * 10_000_000),
    "MemoryError": MemoryError,
    "OSError": lambda: OSError(errno.ENOSPC, "No space left on device"),
}
PLACE, ERROR = "DREAMFLEET_TEST_PLACE", "DREAMFLEET_TEST_ERROR"


class Raising(Toy):
    """Raises the error `ERROR` at `PLACE`: in make, reset, step or begin."""

    def make_environment(self, assignment):
        raise_at("make")
        return RaisingEnvironment()

    def make_policy(self, assignment):
        raise_at("policy")
        return super().make_policy(assignment)


class RaisingEnvironment(ToyEnvironment):
    def reset(self, **more):
        raise_at("reset")
        return super().reset(**more)

    def step(self, action):
        raise_at("step")
        return super().step(action)


def raise_at(place):
    if os.environ.get(PLACE) == place:
        raise ERRORS[os.environ[ERROR]]()
