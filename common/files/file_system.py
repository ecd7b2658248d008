"""Whether a folder's file system keeps the locks that a journal needs; network file systems may not."""

import fcntl
import shutil
import sqlite3
import tempfile
from contextlib import closing, suppress
from pathlib import Path

MOUNTS = Path("/proc/self/mountinfo")
NETWORK = frozenset({
    "9p", "afs", "beegfs", "ceph", "cifs", "coda", "davfs", "glusterfs", "gpfs", "lustre", "ncpfs", "nfs", "nfs4",
    "orangefs", "panfs", "pvfs2", "smb3", "smbfs", "wekafs",
})  # fmt: skip
ROOM = 1 << 18  # bytes that the trial needs
LEAST_ROOM = 1 << 16  # bytes; the index of a write-ahead log has half of them
REMEDY = (  # also in docs/how-to/back-up.md and docs/how-to/troubleshooting.md
    "choose a --runs-dir on a local disk, such as $TMPDIR or the node's /scratch, and copy the run's folder from there "
    "when its coordinator has ended"
)


def file_system_type(path: Path, mounts: Path = MOUNTS) -> str:
    """The type of the file system that `path` lies on, as the kernel names it; empty if it is not known."""
    where, found, longest = path.absolute(), "", -1
    with suppress(OSError):
        where = path.resolve()
        for line in mounts.read_text(errors="replace").splitlines():
            mount, _, source = line.partition(" - ")
            fields = mount.split(" ")
            if len(fields) < 5 or not source:
                continue
            point = Path(fields[4].replace("\\040", " "))
            if where.is_relative_to(point) and len(point.parts) >= longest:  # the last one covers the others
                found, longest = source.split(" ")[0], len(point.parts)
    return found


def is_network(file_system: str) -> bool:
    """Whether a type is of a file system that other hosts may write too; of FUSE it is not known, so all count."""
    return file_system in NETWORK or file_system.partition(".")[0] == "fuse"


def lock_problem(folder: Path) -> str:
    """Why journals cannot be kept in a folder, with the remedy; empty if locks work, or the folder is not writable."""
    where = next((each for each in (folder, *folder.absolute().parents) if each.is_dir()), None)
    if where is None or not (failure := _lock_failure(where)):
        return ""
    kind = file_system_type(where)
    on = f", a network file system ({kind})" if is_network(kind) else f" ({kind})" if kind else ""
    return f"locks fail on {where}{on}: {failure}; {REMEDY}"


def disk_problem(folder: Path) -> str:
    """Why SQLite may have had an I/O error in a folder, with the remedy: no room, or no locks; empty if neither.

    It calls a disk full where it writes a database, but not where it finds no room for the log's index.
    """
    with suppress(OSError):
        if shutil.disk_usage(folder).free < LEAST_ROOM:
            return "the disk is full: make room"
    return lock_problem(folder)


def _lock_failure(folder: Path) -> str:
    """The error of a whole file's lock, or of a database with a write-ahead log and its shared memory."""
    try:
        made = tempfile.TemporaryDirectory(dir=folder, prefix=".locks-", ignore_cleanup_errors=True)
    except OSError:
        return ""  # who writes there says it better
    with made as name:
        lock = Path(name) / "lock"
        try:
            lock.write_bytes(bytes(ROOM))
        except OSError:  # no room
            return ""
        try:
            with lock.open("w") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with closing(sqlite3.connect(Path(name) / "database", timeout=0)) as database:
                database.execute("PRAGMA journal_mode = WAL")
                database.execute("CREATE TABLE probe (number INTEGER)")
                database.commit()
        except sqlite3.OperationalError as error:
            return f"SQLite says {error}"
        except OSError as error:
            return str(error.strerror)
    return ""
