"""The key by which a worker shows that it is on the coordinator's own host: a file that only their user can read.

Hosts may share a home, and so the file: their keys differ by what each host knows of itself. Pages: files.md, trust.md.
"""

import hmac
import os
import platform
import secrets
import stat
from contextlib import suppress
from pathlib import Path

from dreamfleet.common.artifacts.bundle_store import default_cache
from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.files.regular_files import open_regular

NAME, BYTES = "host.key", 32
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # Linux: drawn as the machine starts


def make_host_key() -> bytes:
    """This user's key on this host, made if there is none; empty if the cache folder cannot hold it."""
    with suppress(OSError, DreamfleetError):
        path = _path()
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with (
            suppress(FileExistsError),
            os.fdopen(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "wb") as f,
        ):
            f.write(secrets.token_bytes(BYTES))
    return _read()


def host_token(worker: str) -> str:
    """What shows that `worker`, `name/process`, runs on this host as this user; empty if there is no key."""
    return token_for(_read(), worker)


def token_for(key: bytes, worker: str) -> str:
    """The token that a worker sends, 64 hexadecimal digits; empty without a key."""
    return hmac.digest(key, worker.encode(), "sha256").hex() if len(key) == BYTES else ""


def is_token_of(key: bytes, worker: str, token: str) -> bool:
    """Whether a token is that of this key and worker."""
    expected = token_for(key, worker)
    return bool(expected) and hmac.compare_digest(expected.encode(), token.encode())


def _path() -> Path:
    return default_cache() / NAME


def _read() -> bytes:
    """This host's key; empty if there is none, or if another user made or may read the file, as in a shared cache."""
    with suppress(OSError, DreamfleetError), open_regular(_path(), BYTES) as file:
        found = os.fstat(file.fileno())
        if found.st_uid == os.geteuid() and not found.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            kept = file.read()
            return hmac.digest(kept, _machine().encode(), "sha256") if len(kept) == BYTES else b""
    return b""


def _machine() -> str:
    """What no other machine has: the one of this start, or elsewhere than on Linux the host's name."""
    with suppress(OSError):
        return BOOT_ID.read_text().strip()
    return platform.node()
