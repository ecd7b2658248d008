"""A game's process ends with the one that started it, and leaves nothing behind."""

import ctypes
import os
import queue
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from dreamfleet import ControllerShape, TaskSpec, UsageError
from dreamfleet.worker.service.child import ChildReady, ScorerArguments
from dreamfleet.worker.service.child_process import ChildProcess
from dreamfleet.worker.worlds.takecover import process
from dreamfleet.worker.worlds.takecover.game import TakeCover
from dreamfleet.worker.worlds.takecover.process import ARGUMENTS, FOLDER_PREFIX, GAME_NAME_FLAG, SHARED_FILES
from tests.support.doom import games, has_ended, name_of_game, search_path, shared_files
from tests.support.processes import DEADLINE

PR_CAPBSET_DROP, CAP_DAC_OVERRIDE = 24, 1  # of Linux's prctl
PROGRAM = """
import os, signal, sys
from dreamfleet.worker.worlds.takecover.game import TakeCover
game = TakeCover(4)
game.reset(seed=1)
print("plays", flush=True)
sys.stdin.readline()
"""
KILL = "os.kill(os.getpid(), signal.{})"


def start_program(ending, **more):
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM + ending], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": search_path()}, **more,
    )  # fmt: skip


def folders(temporary):
    """The folders in which games were started; other libraries have files of their own there."""
    return list(temporary.glob(f"{FOLDER_PREFIX}*"))


def only_game(parent):
    """Descriptor and name of the one game of this process."""
    (game,) = games(parent)
    return os.pidfd_open(game), name_of_game(game)


@pytest.fixture
def game(doom, tmp_path, monkeypatch):
    (tmp_path / "current").mkdir()
    monkeypatch.chdir(tmp_path / "current")
    game = TakeCover(4)
    game.reset(seed=1)
    yield game
    game.close()


def test_nothing_is_left_while_a_game_plays_nor_afterwards(temporary, game):
    running, name = only_game(os.getpid())
    assert (list(Path().iterdir()), folders(temporary), shared_files(name)) == ([], [], [])
    game.step(0)
    game.close()
    assert has_ended(running)
    assert (list(Path().iterdir()), folders(temporary), shared_files(name)) == ([], [], [])


@pytest.mark.parametrize("ending", [KILL.format("SIGKILL"), KILL.format("SIGTERM"), "os._exit(3)", "sys.exit()"])
def test_a_game_ends_with_its_process_however_that_ends(doom, temporary, tmp_path, ending):
    with start_program(ending, cwd=tmp_path) as program:
        assert program.stdout.readline() == "plays\n"
        running, name = only_game(program.pid)
        program.communicate("\n", timeout=DEADLINE)
    assert has_ended(running)
    assert (folders(temporary), shared_files(name)) == ([], [])


def test_a_game_ends_with_its_slot(doom, temporary):
    events = queue.SimpleQueue()
    spec = TaskSpec("takecover", "", horizon=525, patience=0, controller=ControllerShape(128, 3))
    child = ChildProcess(ScorerArguments(spec, None, ("takecover",)), events.put)
    assert isinstance(events.get(timeout=DEADLINE), ChildReady)
    running, name = only_game(child.pid)
    os.kill(child.pid, signal.SIGKILL)
    assert has_ended(running)
    child.close()
    assert (folders(temporary), shared_files(name)) == ([], [])


def test_signals_to_all_processes_of_a_service_do_not_end_a_game(game):
    (running,) = games(os.getpid())
    for number in (signal.SIGINT, signal.SIGTERM):
        os.kill(running, number)
    assert (game.step(0)[1], games(os.getpid())) == (4.0, {running})


@pytest.mark.needs_doom
def test_a_game_outlives_the_thread_that_started_it():
    game = TakeCover(4)
    starting = threading.Thread(target=lambda: game.reset(seed=1))
    starting.start()
    starting.join()
    assert [game.step(0)[1] for _ in range(10)] == [4.0] * 10
    game.close()


def test_a_current_folder_that_cannot_be_written_is_no_crash(doom, temporary, tmp_path):
    current = tmp_path / "current"
    current.mkdir(mode=0o555)
    ending = 'print(os.access(".", os.W_OK), game.step(0)[1])'
    drop = lambda: ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE)  # noqa: E731 - a superuser's right
    with start_program(ending, cwd=current, preexec_fn=drop) as program:
        out, _ = program.communicate("\n", timeout=DEADLINE)
    assert (program.returncode, out) == (0, "plays\nFalse 4.0\n")


def test_temporary_files_that_cannot_be_programs_are_named(doom, temporary, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.X_OK)  # as on a file system without programs
    with pytest.raises(UsageError, match=str(temporary)):
        TakeCover(4).reset(seed=1)
    assert folders(temporary) == []


def test_a_game_that_does_not_start_is_an_error_and_leaves_nothing(fake_doom, temporary, monkeypatch):
    monkeypatch.setattr(sys.modules["vizdoom"], "__file__", "/nowhere/vizdoom.so")
    game = TakeCover(4)
    with pytest.raises(Exception, match="ViZDoom"):
        game.reset(seed=1)
    game.close()
    assert (folders(temporary), games(os.getpid())) == ([], set())


def test_a_crashed_game_is_an_error_and_the_next_episode_starts_another(game):
    first, _ = game.reset(seed=1)
    running, _ = only_game(os.getpid())
    signal.pidfd_send_signal(running, signal.SIGKILL)
    assert has_ended(running)
    with pytest.raises(Exception, match=r"crash|not running"):
        game.step(0)
    assert (game.reset(seed=1)[0] == first).all()


def test_what_a_killed_start_left_is_removed_by_the_next(temporary, tmp_path, monkeypatch):
    monkeypatch.setattr(process, "SHARED_MEMORY", tmp_path)
    with subprocess.Popen(["true"]) as ended:
        pass
    for owner, name in ((ended.pid, "abcdefghij"), (os.getpid(), "0123456789")):
        folder = temporary / f"{FOLDER_PREFIX}{owner}-xyz"
        folder.mkdir()
        (folder / ARGUMENTS).write_text(f"-skill\n4\n{GAME_NAME_FLAG}\n{name}\n-nosound\n")
        for each in SHARED_FILES:
            (tmp_path / f"{each}{name}").touch()
    (temporary / f"{FOLDER_PREFIX}{ended.pid}-early").mkdir()
    (temporary / f"{FOLDER_PREFIX}mine").mkdir()
    process.remove_leftovers()
    assert {each.name for each in temporary.iterdir()} == {f"{FOLDER_PREFIX}{os.getpid()}-xyz", f"{FOLDER_PREFIX}mine"}
    assert {each.name for each in tmp_path.iterdir()} - {"temporary"} == {f"{each}0123456789" for each in SHARED_FILES}


def test_a_launcher_takes_folders_with_any_name(tmp_path):
    folder = tmp_path / "it's a $folder"
    folder.mkdir()
    launcher = folder / "launcher"
    launcher.write_text(process.launcher_text(folder, Path("/bin/pwd"), os.getpid()))
    launcher.chmod(0o700)
    done = subprocess.run([launcher, "-P"], capture_output=True, text=True, check=True, timeout=DEADLINE)
    assert done.stdout == f"{folder}\n"
    assert (folder / ARGUMENTS).read_text() == "-P\n"
