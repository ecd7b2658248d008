"""The agent on a remote host: inspects it, installs and starts workers, shows their logs and ends them.

This file is sent over ssh and run by the Python found there: so it is one, imports the standard library only, and has
locks and private files of its own. In reading order: `Channel` takes requests and sends answers, `HostFolder` keeps
what is ours apart from what is not, `WorkerProcess` knows one worker, and each of the `ACTIONS` is a function.

A request is a line of JSON on stdin, followed by the files that it names. An answer is lines on stdout that begin with
`MARK`: `say` or `line` as it works, then `ok` or `failed`. A lock keeps two commands from changing a host at the same
time. Pages: files.md.
"""

import errno
import fcntl
import importlib.metadata
import importlib.util
import json
import os
import platform
import select
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO

MARK = "dreamfleet-host "
TICK = 0.1  # seconds between polls
START_TIMEOUT = 60.0  # seconds until a started worker must have begun
DRAIN_TIMEOUT = 900.0  # seconds that a draining worker may take
STOP_AT_ONCE = ((signal.SIGTERM, 1.0), (signal.SIGTERM, 10.0), (signal.SIGKILL, 30.0))  # each with its timeout
STOP_DRAINED = ((signal.SIGTERM, DRAIN_TIMEOUT),)
MOST_ATTEMPTS = 20  # to create a folder that other commands remove
LEAST_FREE = 700_000_000  # bytes needed while an environment is made
ROOM, LEAST_ROOM = "room", 1 << 16  # a file, and its bytes, that must fit before a worker is replaced
LONGEST_TAIL = 8192  # bytes read from the end of a log for its last line
LONGEST_LIST = 1 << 20  # bytes read of the list of folders
JOIN, LOG, STATE, COMPLETE, CREATED = "join", "log", "worker.json", "whole", "made"
REPORTS, REPORTS_VARIABLE = "reports", "DREAMFLEET_REPORTS"  # a worker reports there that it has begun, or failed
FOLDERS = ("environments", "workers", "cache")  # under the root
LOCK, LOCK_CONTENT = "lock", b"dreamfleet\n"
# Starts a worker only once a line says that its state is written: one that nobody knows of could not be ended.
ONCE_KNOWN = ("/bin/sh", "-c", 'read known && exec "$@" </dev/null', "sh")
PR_SET_PDEATHSIG = 1  # prctl(2)
JOIN_HERE = "{join}"  # placeholder for the join file's path


class FailedError(Exception):
    """A request failed; the text says why and what to do."""


class Channel:
    """Requests on stdin and answers on stdout."""

    def __init__(self) -> None:
        self._waiting = b""

    def request(self) -> dict[str, Any]:
        """The next request; empty for an empty line, which only interrupts `follow`."""
        while b"\n" not in self._waiting:
            self._read()
        text, _, self._waiting = self._waiting.partition(b"\n")
        request: dict[str, Any] = json.loads(text or b"{}")
        return request

    def file(self, size: int) -> bytes:
        """Read a file of `size` bytes that follows a request."""
        while len(self._waiting) < size:
            self._read()
        data, self._waiting = self._waiting[:size], self._waiting[size:]
        return data

    def wait_for_request(self, seconds: float = TICK) -> bool:
        """Wait for a request; whether one came. `EOFError` if the connection is closed."""
        if not self._waiting and select.select([0], [], [], seconds)[0]:
            self._read()
        return bool(self._waiting)

    def send(self, kind: str, content: Any) -> None:
        """Send a message or an answer; ignored if the connection is closed."""
        with suppress(BrokenPipeError):
            print(MARK + json.dumps({kind: content}), flush=True)  # noqa: T201 - the answer

    def _read(self) -> None:
        data = os.read(0, 1 << 20)
        if not data:
            raise EOFError
        self._waiting += data


class HostFolder:
    """The folder on this host that holds environments, workers and caches."""

    def __init__(self, text: str, channel: Channel) -> None:
        try:
            self.root = Path(text).expanduser().absolute()
        except RuntimeError as error:
            raise FailedError(f"{text}: no such user there, name another --remote-dir") from error
        self.channel = channel
        self.lock = -1  # the lock's descriptor while it is held

    @property
    def caches(self) -> dict[str, str]:
        """Environment variables that keep caches in this folder instead of the user's home."""
        return {"DREAMFLEET_CACHE": str(self.root / "cache"), "XDG_CACHE_HOME": str(self.root / "cache")}

    @property
    def is_ours(self) -> bool:
        """Whether this program created the folder, by what its files hold: others may have files of the same names.

        One that was killed as it created or removed the folder leaves no more than the lock or a file half written.
        """
        if self._listed() is not None or any(WorkerProcess(self.worker(each)).state for each in self.names("workers")):
            return True
        found = set[str]()
        with suppress(FileNotFoundError, NotADirectoryError):
            found = {each.name for each in self.root.iterdir()}
        begun, lock = aside(self.root / CREATED), self.root / LOCK
        return bool(found) and found <= {
            *([begun.name] if _content(begun)[:1] in b"[" else []), *([LOCK] if _content(lock) == LOCK_CONTENT else [])
        }  # fmt: skip

    @property
    def removal(self) -> str:
        """A shell command that removes everything of ours."""
        return f"cd {shlex.quote(str(self.root))} && rm -rf {' '.join((*FOLDERS, CREATED, LOCK))}"

    def check_mine(self) -> None:
        """`FailedError` if other users may change what is ours, or put something of theirs there in its place.

        A link of this user's may lead to the folder, but none inside it.
        """
        for path in (self.root, *(self.root / each for each in (*FOLDERS, CREATED, LOCK))):
            with suppress(FileNotFoundError, NotADirectoryError):
                link = path.lstat()
                if stat.S_ISLNK(link.st_mode) and path != self.root:
                    raise FailedError(f"{path} is a link: remove it, or name another --remote-dir")
                found = path.stat()
                if not {link.st_uid, found.st_uid} <= {os.geteuid(), 0}:
                    raise FailedError(f"{path} is another user's: name another --remote-dir")
                # Counts alike: common/files/regular_files.py.
                by_group = bool(found.st_mode & stat.S_IWGRP) and found.st_gid != os.geteuid()
                if by_group or found.st_mode & stat.S_IWOTH:
                    raise FailedError(
                        f"others may write to {path}: name another --remote-dir, or if all there is yours: "
                        f"chmod go-w {shlex.quote(str(path))}"
                    )

    def environment(self, name: str) -> Path:
        """The folder of an environment."""
        return self.root / "environments" / name

    def is_complete(self, name: str) -> bool:
        """Whether an environment is installed and its Python still exists."""
        folder = self.environment(name)
        return (folder / COMPLETE).exists() and (folder / "bin" / "python").exists()

    def worker(self, name: str) -> Path:
        """The folder of a worker's state, log and join file."""
        return self.root / "workers" / name

    def names(self, kind: str) -> list[str]:
        """The names of all `environments` or `workers`."""
        with suppress(FileNotFoundError):
            return sorted(each.name for each in (self.root / kind).iterdir() if each.is_dir())
        return []

    @contextmanager
    def locked(self, *, creating: bool = True) -> Iterator[bool]:
        """Hold the folder's lock, which every command that changes it takes.

        Creates the folder if needed, or else yields False if it is not ours.
        """
        for attempt in count():
            if not creating and not self.is_ours:
                yield False
                return
            try:
                lock, made, ours = self._enter() if creating else (self._open_lock(), [], True)
            except FileNotFoundError:  # the last holder removed the folder, here and below
                if attempt > MOST_ATTEMPTS:
                    raise
                continue
            with lock:
                self._acquire(lock.fileno())
                held = False
                with suppress(FileNotFoundError):
                    held = os.path.samestat(os.fstat(lock.fileno()), (self.root / LOCK).stat())
                if held:
                    self.check_mine()  # now that it exists, nobody else makes it
                    if creating:
                        self._record(made, ours)
                    self.lock = lock.fileno()
                    yield True
                    return

    def remove(self) -> None:
        """Remove everything of ours; folders with other content stay. `OSError` if something of ours stays."""
        made = self._made()
        for name in FOLDERS:
            remove_tree(self.root / name)
        for path in (self.root / CREATED, aside(self.root / CREATED), self.root / LOCK):  # only after the folders
            path.unlink(missing_ok=True)
        _remove_empty(made)

    def _made(self) -> list[Path]:
        """The folders that this program created, the root first; without their list, the root."""
        listed = self._listed()
        return [self.root] if listed is None else [
            each for each in (self.root, *self.root.parents) if str(each) in listed
        ]  # fmt: skip

    def _listed(self) -> list[str] | None:
        """The list of the folders that this program created; `None` if there is none, or it is not as we write it."""
        with suppress(ValueError, RecursionError):
            listed = json.loads(_content(self.root / CREATED))
            if isinstance(listed, list) and all(isinstance(each, str) and each.startswith("/") for each in listed):
                return listed
        return None

    def _enter(self) -> tuple[BinaryIO, list[Path], bool]:
        """Create the folder if needed, and open its lock; also the folders made for it, and whether it was ours."""
        with suppress(RuntimeError):  # this user has no home
            if Path.home().resolve().is_relative_to(self.root.resolve()):  # people put files of their own there
                raise FailedError(f"{self.root} is no folder of its own: name another --remote-dir")
        for attempt in count():
            before, ours = self._taken(), self.is_ours
            if not before or ours or not (strange := self._taken()):
                break
            if attempt > 1:
                raise FailedError(f"{self.root} holds {strange[0]} of something else: name another --remote-dir")
            time.sleep(TICK)  # another command may make or remove it at this moment
        missing = [each for each in (self.root, *self.root.parents) if not each.exists()]
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            return self._open_lock(), missing, ours
        except OSError:
            _remove_empty(missing)
            raise

    def _record(self, made: list[Path], ours: bool) -> None:
        """List the folders that were `made`, and make those inside, so that what is in them later is in ours."""
        listed = self._listed()
        known = ([str(self.root)] if ours else []) if listed is None else listed
        new = [str(each) for each in made if str(each) not in known]
        try:
            if new or listed is None:
                _write_private(self.root / CREATED, json.dumps([*known, *new]).encode())
            for name in FOLDERS:
                (self.root / name).mkdir(exist_ok=True)
        except OSError:
            if listed is None:
                for name in (CREATED, LOCK):
                    (self.root / name).unlink(missing_ok=True)
                _remove_empty([*(self.root / name for name in FOLDERS), *made])
            raise

    def _taken(self) -> list[str]:
        """The names of ours that something in the folder has."""
        return [each for each in (*FOLDERS, CREATED, LOCK) if os.path.lexists(self.root / each)]

    def _open_lock(self) -> BinaryIO:
        """Open or create the lock file, whose content says that it is ours."""
        path = self.root / LOCK
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            file = open(os.open(path, flags, 0o666), "r+b", buffering=0)  # noqa: SIM115 - the caller closes it
            if stat.S_ISREG((found := os.fstat(file.fileno())).st_mode):
                if not found.st_size:
                    with suppress(OSError):  # a full disk must not prevent a removal
                        file.write(LOCK_CONTENT)
                return file
            file.close()
        except OSError as error:
            if error.errno not in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
                raise
        raise FailedError(f"{path} is not a regular file: remove it")

    def _acquire(self, lock: int) -> None:
        for attempt in count():
            with suppress(BlockingIOError):
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            if not attempt:
                self.channel.send("say", "another command works there: waiting for it")
            self.channel.wait_for_request()


def aside(path: Path) -> Path:
    """Where a file is written before it takes its name."""
    return path.with_name(f".{path.name}")


def _content(path: Path) -> bytes:
    """The beginning of a regular file; empty without one."""
    with suppress(FileNotFoundError):  # another command may remove it
        if path.is_file():
            with path.open("rb") as file:
                return file.read(LONGEST_LIST)
    return b""


def remove_tree(folder: Path) -> None:
    """Remove a folder and what is in it, also what its owner made read-only; `OSError` if something stays."""
    if folder.is_symlink() or not folder.exists():
        folder.unlink(missing_ok=True)
        return
    _make_writable(folder)
    shutil.rmtree(folder)


def _make_writable(folder: Path) -> None:
    with suppress(PermissionError):  # another user's: removing it says so
        folder.chmod(stat.S_IRWXU)
    with os.scandir(folder) as inside:
        for each in inside:
            if each.is_dir(follow_symlinks=False):
                _make_writable(Path(each.path))


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def process_start(pid: int) -> str:
    """When the process began, to detect a reused process id; empty if it does not run."""
    try:
        facts = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except (FileNotFoundError, ProcessLookupError):
        if Path("/proc/self/stat").exists():
            return ""
        words = ("ps", "-o", "stat=,lstart=", "-p", str(pid))
        listed = subprocess.run(words, capture_output=True, text=True, check=False)
        state, _, began = listed.stdout.strip().partition(" ")
        return "" if state.startswith("Z") else began.strip()
    return "" if facts[0] in "ZX" else f"{boot} {facts[19]}"  # proc_pid_stat(5): state, and the start in ticks


def workers_in(folder: Path) -> list[int]:
    """The processes of workers that were started in a folder, whatever their state says; none without `/proc`."""
    found = list[int]()
    for each in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended, or is another user's
            words, pid = (each / "cmdline").read_bytes().split(b"\0"), int(each.name)
            begun = b"worker" in words and ONCE_KNOWN[2].encode() not in words  # else the shell, which ends by itself
            if begun and os.getsid(pid) == pid and (each / "cwd").samefile(folder):
                found.append(pid)
    return sorted(found)


class WorkerProcess:
    """A worker's stored state, and whether it still runs."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.state: dict[str, Any] = {}
        with suppress(FileNotFoundError, ValueError):
            self.state = _checked_state(json.loads((folder / STATE).read_text()))

    @property
    def is_alive(self) -> bool:
        """Whether the process that was started still runs, on this host."""
        with suppress(ChildProcessError):
            os.waitpid(-1, os.WNOHANG)  # reap our own children
        # A start names the boot too, so that no process of another host has an equal one.
        return bool(self.state) and bool(process_start(self.state["pid"]) == self.state["birth"])

    @property
    def tunnel_pid(self) -> int:
        """The agent process that holds the worker's tunnel; 0 if there is none or it ended."""
        pid, began = self.state.get("holder", (0, ""))
        return pid if pid and process_start(pid) == began else 0

    def check_known(self) -> None:
        """`FailedError` with the remedy if it may run although this agent cannot end it."""
        name = self.folder.name
        if self.state and self.state["node"] != platform.node() and not self.is_alive:
            raise FailedError(
                f"worker {name} was started by {self.state['node']}, which shares this folder or is this host's former "
                "name: give each host a name of its own, or run `dreamfleet down` for that host; if the worker no "
                f"longer runs, remove it with: rm -rf {shlex.quote(str(self.folder))}"
            )
        if not self.state and (found := workers_in(self.folder)):
            raise FailedError(
                f"worker {name} runs, and its {STATE} is lost or damaged: end it there with "
                f"`kill {' '.join(map(str, found))}`, then repeat this"
            )

    def describe(self) -> dict[str, Any]:
        """Its state, as sent to the other side."""
        running = self.is_alive
        age = max(time.time() - self.state["since"], 0.0) if running else None  # its clock may have been set back
        return {"name": self.folder.name, "running": running, "slots": self.state.get("slots"), "age": age,
                "digest": self.state.get("digest"), "last": last_line(self.folder / LOG)}  # fmt: skip

    def end(self, channel: Channel, steps: tuple[tuple[signal.Signals, float], ...]) -> None:
        """Send it the signals of `steps` in turn, each with its timeout; `FailedError` if it still runs."""
        for number, seconds in steps:
            if not self.is_alive:
                return
            with suppress(ProcessLookupError):  # it leads a group with its scoring processes
                (os.killpg if number == signal.SIGKILL else os.kill)(self.state["pid"], number)
            deadline = time.monotonic() + seconds
            while self.is_alive and time.monotonic() < deadline:
                channel.wait_for_request() if len(steps) == 1 else time.sleep(TICK)
        if self.is_alive:
            raise FailedError(f"worker {self.folder.name} does not leave: end it with --now")


def _checked_state(state: Any) -> dict[str, Any]:
    """A worker's state as `_launch` wrote it; empty if that was prevented, or something else wrote the file."""
    kinds: dict[str, type] = {"pid": int, "birth": str, "node": str, "digest": str, "slots": int, "since": float}
    whole = isinstance(state, dict) and all(isinstance(state.get(name), kind) for name, kind in kinds.items())
    if not whole:
        return {}
    holder = state.get("holder", [0, ""])
    return state if isinstance(holder, list) and [type(each) for each in holder] == [int, str] else {}


def last_line(log: Path) -> str:
    """The last log line of a worker."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - LONGEST_TAIL))
            lines = file.read().decode(errors="replace").splitlines()
    except FileNotFoundError:
        return ""
    said = [each.strip() for each in lines if each.strip()]
    return said[-1] if said else ""


def inspect_host(host_folder: HostFolder, _request: dict[str, Any]) -> dict[str, Any]:
    """Describe the host, its environments and workers; changes nothing."""
    there = next(each for each in (host_folder.root, *host_folder.root.parents) if each.exists())
    installed = None
    with suppress(importlib.metadata.PackageNotFoundError):
        installed = importlib.metadata.version("dreamfleet")
    return {
        "python": list(sys.version_info[:2]), "executable": sys.executable, "machine": platform.machine(),
        "system": platform.system(), "installed": installed,
        "venv": importlib.util.find_spec("venv") is not None and importlib.util.find_spec("ensurepip") is not None,
        "writable": os.access(there, os.W_OK),
        "noexec": bool(os.statvfs(there).f_flag & getattr(os, "ST_NOEXEC", 0)),
        "root": str(host_folder.root), "free": shutil.disk_usage(there).free,
        "environments": [each for each in host_folder.names("environments") if host_folder.is_complete(each)],
        "workers": [WorkerProcess(host_folder.worker(each)).describe() for each in host_folder.names("workers")],
    }  # fmt: skip


def install(host_folder: HostFolder, request: dict[str, Any]) -> dict[str, Any]:
    """Make the environment of this name unless it is complete; return its Python."""
    folder = host_folder.environment(request["environment"])
    with host_folder.locked():
        if host_folder.is_complete(request["environment"]):
            return {"python": str(folder / "bin" / "python")}
        remove_tree(folder)  # left by an interrupted attempt
        parcel = folder / "parcel"
        parcel.mkdir(parents=True)
        for name, data in request["files"].items():
            (parcel / Path(name).name).write_bytes(data)
        host_folder.channel.send("say", "makes its environment")
        _call(host_folder, sys.executable, "-m", "venv", str(folder))
        python = str(folder / "bin" / "python")
        origin = "" if request["offline"] else ", from the package index"
        host_folder.channel.send("say", f"installs the worker{origin}")
        source = ("--no-index", "--find-links", ".") if request["offline"] else ("--constraint", "pins.txt")
        flags = ("--quiet", "--no-cache-dir", "--disable-pip-version-check", *source)
        _call(host_folder, python, "-m", "pip", "install", *flags, f"./{request['wheel']}[worker]", inside=parcel)
        shutil.rmtree(parcel)
        (folder / COMPLETE).touch()
    return {"python": python}


def _call(host_folder: HostFolder, *command: str, inside: Path | None = None) -> None:
    """Run a command of the installation; `FailedError` with the reason and a remedy."""
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, cwd=inside,
        env={**os.environ, **host_folder.caches},
        pass_fds=(host_folder.lock,),  # it outlives an agent that is killed, and until then others must wait
    )  # fmt: skip
    if done.returncode == 0:
        return
    said = [each.strip() for each in (done.stdout + done.stderr).splitlines() if each.strip()]
    text = "\n".join(said)
    if "ensurepip" in text and "-m venv" in " ".join(command):
        raise FailedError("its Python has no venv: install it there (Debian: apt install python3-venv)")
    if "No space left" in text or "Errno 28" in text:
        raise OSError(errno.ENOSPC, "no space left")
    why = next((each for each in said if "ERROR: " in each), said[-1] if said else f"exit code {done.returncode}")
    raise FailedError(
        f"the worker cannot be installed ({why.removeprefix('ERROR: ')}): if it reaches no package index that has "
        "all it needs, give --wheelhouse; if dreamfleet is installed there, give --remote-python"
    )


def start(host_folder: HostFolder, request: dict[str, Any]) -> dict[str, Any]:
    """Start a worker unless the same one runs; a different one of its name is drained first."""
    folder = host_folder.worker(request["name"])
    with host_folder.locked():
        found = WorkerProcess(folder)
        if found.is_alive and found.tunnel_pid:
            raise FailedError("a worker of this name runs by the tunnel of another command: end that one first")
        if found.is_alive and not request["held"] and found.state["digest"] == request["digest"]:
            return {**found.describe(), "outcome": "running"}
        found.check_known()
        outcome = "replaced" if found.is_alive else "started"
        if found.is_alive:  # a full disk must fail before it ends
            _write_private(folder / ROOM, bytes(LEAST_ROOM))
            (folder / ROOM).unlink()
        found.end(host_folder.channel, STOP_DRAINED)
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in request["files"].items():
            _write_private(folder / name, data)
        began = _launch(host_folder, folder, request)
    _wait_for_begin(began, folder, host_folder.channel)
    return {**WorkerProcess(folder).describe(), "outcome": outcome}


def _write_private(path: Path, data: bytes) -> None:
    """Write a file atomically, readable by this user only whatever the umask."""
    new = aside(path)
    try:
        with open(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
            file.write(data)
        new.chmod(0o600)
        new.replace(path)
    except OSError:
        new.unlink(missing_ok=True)
        raise


def _launch(host_folder: HostFolder, folder: Path, request: dict[str, Any]) -> subprocess.Popen[bytes]:
    log = folder / LOG
    for path in (log, folder / REPORTS):
        path.unlink(missing_ok=True)
    _write_private(folder / STATE, b"{}")  # a full disk must fail before anything runs
    words = [request["python"], *(str(folder / JOIN) if each == JOIN_HERE else each for each in request["words"])]
    Path(request["python"]).stat()  # a shell's error would name no errno
    with log.open("xb") as out:
        began = subprocess.Popen(
            [*ONCE_KNOWN, *words], stdin=subprocess.PIPE, stdout=out, stderr=out, start_new_session=True, cwd=folder,
            env={**os.environ, **host_folder.caches, **request["env"], REPORTS_VARIABLE: str(folder / REPORTS)},
            preexec_fn=_end_with_agent if request["held"] else None,  # noqa: PLW1509 - the agent has one thread
        )  # fmt: skip
    assert began.stdin is not None
    state = {"digest": request["digest"], "slots": request["slots"], "since": time.time(), "node": platform.node(),
             "pid": began.pid, "birth": process_start(began.pid)}  # fmt: skip
    if request["held"]:
        state["holder"] = [os.getpid(), process_start(os.getpid())]
    with began.stdin:  # closed without a word, it ends the shell
        _write_private(folder / STATE, json.dumps(state).encode())
        began.stdin.write(b"\n")
    return began


def _end_with_agent() -> None:
    """Have Linux end this process with the agent, also with one that is killed: its tunnel is gone then."""
    with suppress(ImportError, OSError, AttributeError):
        import ctypes

        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


def _wait_for_begin(began: subprocess.Popen[bytes], folder: Path, channel: Channel) -> None:
    """Wait until the worker reports that it has begun; `FailedError` if it failed instead."""
    deadline = time.monotonic() + START_TIMEOUT
    while began.poll() is None and time.monotonic() < deadline:
        if "begun" in _reports(folder) and last_line(folder / LOG):  # which its status then shows
            return
        channel.wait_for_request()
    if began.poll() or (began.poll() is not None and "begun" not in _reports(folder)):
        why = _reports(folder).get("failure") or last_line(folder / LOG) or f"exit code {began.returncode}"
        raise FailedError(f"its worker ended at once: {why}")


def _reports(folder: Path) -> dict[str, Any]:
    """What a worker reported, as `common/host/reports.py` writes it."""
    found = dict[str, Any]()
    with suppress(FileNotFoundError, ValueError, TypeError):
        for line in (folder / REPORTS).read_text().splitlines():
            found.update(json.loads(line))
    return found


def follow(host_folder: HostFolder, request: dict[str, Any]) -> dict[str, Any]:
    """Send a worker's log line by line until the worker ends or the next request comes."""
    channel, found = host_folder.channel, WorkerProcess(host_folder.worker(request["name"]))
    rest = b""
    with (found.folder / LOG).open("rb") as log:
        while True:
            over = not found.is_alive
            *lines, rest = (rest + log.read()).split(b"\n")
            for each in lines:
                channel.send("line", each[:LONGEST_TAIL].decode(errors="replace"))
            if over or channel.wait_for_request():
                return {**found.describe(), "ended": over}


def end(host_folder: HostFolder, request: dict[str, Any]) -> dict[str, Any]:
    """End and remove the named workers, or all; remove the whole folder after the last one unless `keep` is set.

    `FailedError` names those that were left alone, once the others have ended.
    """
    channel, ended, left = host_folder.channel, list[dict[str, Any]](), list[str]()
    if (host_folder.root / CREATED).exists() and not host_folder.is_ours:
        raise FailedError(
            f"{host_folder.root / CREATED} is damaged, or of something else: if all there is dreamfleet's, remove it "
            f"with: {host_folder.removal}"
        )
    with host_folder.locked(creating=False) as ours:
        for name in (request["names"] or host_folder.names("workers")) if ours else ():
            found = WorkerProcess(host_folder.worker(name))
            if not found.folder.exists():
                continue
            try:
                found.check_known()
            except FailedError as error:
                left.append(str(error))
                continue
            ended += [found.describe()]
            if found.is_alive:
                channel.send("say", f"worker {name} leaves")
            found.end(channel, STOP_AT_ONCE if request["now"] else STOP_DRAINED)
            remove_tree(found.folder)
        stay = host_folder.names("workers") if ours else []
        if ours and not stay and not request["keep"]:
            host_folder.remove()
    if left:
        raise FailedError("; ".join(left))
    return {"ended": ended, "stay": stay}


ACTIONS: dict[str, Callable[[HostFolder, dict[str, Any]], dict[str, Any]]] = {
    "look": inspect_host, "install": install, "start": start, "follow": follow, "end": end,
}  # fmt: skip


def handle_request(request: dict[str, Any], channel: Channel) -> None:
    """Do what a request says, and answer."""
    request["files"] = {name: channel.file(size) for name, size in request.get("files", [])}
    where = request["root"]
    try:
        host_folder = HostFolder(where, channel)
        host_folder.check_mine()
        channel.send("ok", ACTIONS[request["do"]](host_folder, request))
    except FailedError as error:
        channel.send("failed", str(error))
    except OSError as error:
        if request["do"] == "end":
            why = f"{error.filename or where}: {error.strerror or error}"
            channel.send("failed", f"{why}; what is left there is removed by: {host_folder.removal}")
        elif error.errno in (errno.ENOSPC, errno.EDQUOT):
            channel.send("failed", f"no space left in {where}: make room there, or name another --remote-dir")
        elif error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            channel.send("failed", f"{error.filename or where} cannot be written there: name another --remote-dir")
        else:
            channel.send("failed", str(error))


def main() -> None:
    """Answer requests until the connection closes, then end the workers that used its tunnel."""
    os.umask(0o077)
    channel, held = Channel(), list[dict[str, Any]]()
    print(flush=True)  # noqa: T201 - what the shell printed may lack its line end
    channel.send("ok", {})
    try:
        while True:
            if not (request := channel.request()):
                continue
            if request.get("held"):
                held.append(request)
            handle_request(request, channel)
    except EOFError:
        for each in held:
            host_folder = HostFolder(each["root"], channel)
            if WorkerProcess(host_folder.worker(each["name"])).tunnel_pid == os.getpid():
                with suppress(FailedError, OSError):
                    end(host_folder, {"names": [each["name"]], "now": True, "keep": True})


if __name__ == "__main__":
    main()
