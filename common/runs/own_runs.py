"""Which runs this user began on this host: the user named their task, so its module stays trusted for them.

A file in the user's state folder remembers each. Nothing that travels says it: not a run's folder, and not the cache.
"""

from __future__ import annotations

import json
import logging
import os
import re
import stat
from pathlib import Path

from dreamfleet.common.files.regular_files import read_text
from dreamfleet.common.host.trusted_modules import is_trusted, module_folder, search_in, trust
from dreamfleet.common.protocol.tasks import module_of

log = logging.getLogger(__name__)
MOST_BYTES = 1 << 20  # of such a file
_UID = re.compile("[0-9a-f]{32}")  # a controller's file holds one, and it names a file here


def remember_run(uid: str, task: str, options: str) -> None:
    """Note that this user began a run in a task whose name chooses a trusted module; nothing of other tasks."""
    module = module_of(task)
    if not module or not is_trusted(module):
        return
    try:
        path = _folder() / uid
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.write_text(json.dumps([task, options, str(module_folder(module) or "")]))
    except (OSError, RuntimeError) as error:
        log.warning("other verbs will need --trust %s for this run: %s", module, error)


def trust_own_run(uid: object, task: str, options: str) -> None:
    """Trust the task's module if this user began the run on this host, in this task with these options.

    The module must be found where it lay then, and nobody else may be able to write there.
    """
    module = module_of(task)
    if not module or not isinstance(uid, str) or not _UID.fullmatch(uid):
        return
    try:
        path = _folder() / uid
        if not _is_mine(path.parent) or not _is_mine(path):
            return
        begun = json.loads(read_text(path, MOST_BYTES))
        if not isinstance(begun, list) or begun[:2] != [task, options] or not isinstance(place := begun[-1], str):
            return
        if place and _is_mine(Path(place)):
            search_in(place)
        found = module_folder(module)
        if str(found or "") != place or (found is not None and not _is_mine(found)):
            log.warning("the module %s is not trusted without --trust: it lay in %s when this run began, or others may "
                        "write there", module, place or "an installed package")  # fmt: skip
            return
        trust([module])
    except (OSError, ValueError, RuntimeError):  # no such file, or none of ours
        return


def _folder() -> Path:
    """`RuntimeError` if this user has no home."""
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "dreamfleet" / "own-runs"


def _is_mine(path: Path) -> bool:
    """Whether only this user, its own group and root may write there."""
    found = path.stat()
    by_group = bool(found.st_mode & stat.S_IWGRP) and found.st_gid != os.getegid()
    return found.st_uid in (os.geteuid(), 0) and not by_group and not found.st_mode & stat.S_IWOTH
