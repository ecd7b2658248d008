"""Starting ViZDoom's process so that it ends with ours and leaves nothing behind.

ViZDoom runs the game in a child process and talks to it through three files in /dev/shm. Left alone, the child outlives
a killed parent, those files outlive both, and it writes into the current folder, where it crashes if that cannot be
written. So a launcher starts it in a folder of its own and makes it end with our process. Once it runs, nobody opens
the files or the folder again: they are removed at once, and stay only if a process is killed while it starts a game.
"""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host import parent_death

SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - POSIX shared memory, where ViZDoom puts it
SHARED_FILES = ("ViZDoomSM", "ViZDoomMQCtr", "ViZDoomMQDoom")  # each followed by the name of the game
GAME_NAME_FLAG = "+viz_instance_id"
FOLDER_PREFIX = "dreamfleet-doom-"  # followed by the id of the process that starts a game there
ARGUMENTS = "arguments"  # file in such a folder: what ViZDoom starts the game with, one a line


def start_game(game: Any, program: Path) -> None:
    """Start the process of a configured `vizdoom.DoomGame`, whose executable is `program`.

    The game ends with this process, however that ends, and outlives Ctrl-C and SIGTERM, which are for this process to
    handle. `UsageError` if temporary files cannot be programs; ViZDoom's own error if the game does not start.
    """
    remove_leftovers()
    folder = Path(tempfile.mkdtemp(prefix=f"{FOLDER_PREFIX}{os.getpid()}-"))
    try:
        launcher = folder / "launcher"
        launcher.write_text(launcher_text(folder, program, os.getpid()))
        launcher.chmod(0o700)
        if not os.access(launcher, os.X_OK):  # ViZDoom crashes this process if the game cannot be started
            raise UsageError(f"no program may run in {folder.parent}: let TMPDIR name a folder of another file system")
        game.set_vizdoom_path(str(launcher))
        game.set_doom_config_path(os.devnull)  # read as the game starts, and written as it ends
        with parent_death.signals_blocked():  # the game inherits that
            game.init()
    finally:
        _remove(folder)


def launcher_text(folder: Path, program: Path, parent: int) -> str:
    """A shell script that replaces itself by `program` in `folder`, to be killed as the process `parent` ends."""
    last = shlex.join([sys.executable, "-I", "-S", parent_death.__file__, str(parent), str(program)])
    return (
        "#!/bin/sh\n"
        f"cd {shlex.quote(str(folder))} || exit 1\n"
        f"printf '%s\\n' \"$@\" > {ARGUMENTS}\n"
        f'exec {last} "$@"\n'
    )  # fmt: skip


def remove_leftovers() -> None:
    """Remove what is left of games whose starting process was killed before it had started them."""
    for folder in Path(tempfile.gettempdir()).glob(f"{FOLDER_PREFIX}*"):
        owner = folder.name.removeprefix(FOLDER_PREFIX).partition("-")[0]
        with suppress(OSError, psutil.NoSuchProcess):  # another process removes it, too
            if owner.isdecimal() and folder.lstat().st_uid == os.getuid() and not _is_running(int(owner)):
                _remove(folder)


def _is_running(process: int) -> bool:
    """Whether a process of this user runs; a zombie does not."""
    return psutil.pid_exists(process) and bool(psutil.Process(process).status() != psutil.STATUS_ZOMBIE)


def _remove(folder: Path) -> None:
    """Remove the folder in which a game was started, and the game's files in /dev/shm."""
    with suppress(OSError, ValueError, IndexError):  # the game was never started
        arguments = (folder / ARGUMENTS).read_text().splitlines()
        name = arguments[arguments.index(GAME_NAME_FLAG) + 1]
        for each in SHARED_FILES:
            (SHARED_MEMORY / Path(each + name).name).unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
