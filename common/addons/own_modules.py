"""Trust the module of a run that this user began on this host, if nobody else can change its code.

Pages: trust.md, files.md.
"""

from __future__ import annotations

import json
import logging
import os
import re
import stat
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib.machinery import all_suffixes
from importlib.util import cache_from_source
from pathlib import Path

from dreamfleet.common.files.regular_files import others_write, read_text
from dreamfleet.common.host.trusted_modules import module_folder, module_places, search_in, trust
from dreamfleet.common.protocol.tasks import module_of
from dreamfleet.common.runs.own_runs import own_runs_dir

log = logging.getLogger(__name__)
MOST_BYTES = 1 << 20  # of a file of `own_runs_dir`
MOST_LINKS = 40  # that Linux follows on a path
_UID = re.compile("[0-9a-f]{32}")  # a controller's file holds one, and it names a file here
_CODE = tuple(all_suffixes())  # of a file that Python imports


def trust_own_run(uid: object, task: str, options: str) -> None:
    """Trust the task's module if this user began the run on this host, in this task with these options.

    The module must be found where it lay then, and nobody else may be able to change its code.
    """
    module = module_of(task)
    if not module or not isinstance(uid, str) or not _UID.fullmatch(uid):
        return
    try:
        path = own_runs_dir() / uid
        if _opening(path):
            return
        begun = json.loads(read_text(path, MOST_BYTES))
        if not isinstance(begun, list) or begun[:2] != [task, options] or not isinstance(place := begun[-1], str):
            return
        if place and not _opening(Path(place)):
            search_in(place)
        found, opening = str(module_folder(module) or ""), next(filter(None, map(_opening, _code(module))), None)
        if found == place and not opening:
            trust([module])
            return
        why = f"others may change {opening}" if opening else f"it lay in {place or 'an installed package'} at the start"
        log.warning("the module %s of this run is not trusted without --trust: %s", module, why)
    except (OSError, ValueError, RuntimeError):  # no such file, or none of ours
        return


def _code(module: str) -> Iterator[Path]:
    """What an import of the module may run: the code beside it, and in all folders there, with what is compiled of it.

    Nothing is imported yet that says which of these it names; no import names a folder with a dot in its name.
    """
    places, seen = module_places(module), set[Path]()
    folders = [*(each.parent for each in places), *(each for each in places if each.is_dir())]
    for folder in folders:  # which grows
        yield folder
        if not folder.is_dir() or (real := folder.resolve()) in seen:  # an archive, or a link to what was seen
            continue
        seen.add(real)
        with suppress(PermissionError), os.scandir(folder) as entries:
            for each in entries:
                if each.name.endswith(_CODE):
                    yield Path(each)
                    if sys.pycache_prefix:  # else what is compiled of it lies in a folder here
                        yield Path(cache_from_source(each))
                elif "." not in each.name and os.path.isdir(each):  # noqa: PTH112 - also of a link nobody may follow
                    folders.append(Path(each))


def _opening(path: Path) -> Path | None:
    """Where others may change what the path names: there, in a folder above it, or at a link; `None` if nowhere.

    A folder above may be sticky, as /tmp is: nobody moves what others own there, but all may make what is missing.
    """
    for way in _ways(path.absolute()):
        found = [each for each in (way, *way.parents) if os.path.lexists(each)]
        for each in found:
            if not _is_mine(each, sticky=each != found[0]):
                return each
    return None


def _ways(path: Path) -> Iterator[Path]:
    """The path, and what it becomes with each link on it followed, one after the other."""
    for _ in range(MOST_LINKS):
        yield path
        link = next((each for each in (*reversed(path.parents), path) if each.is_symlink()), None)
        if link is None:
            return
        path = link.parent / link.readlink() / path.relative_to(link)


def _is_mine(path: Path, *, sticky: bool) -> bool:
    """Whether only this user and root may write there, or replace what they own if it is `sticky`.

    Nobody writes to a link.
    """
    found = path.lstat()
    shared = others_write(found) and not (sticky and found.st_mode & stat.S_ISVTX)
    return found.st_uid in (os.geteuid(), 0) and (stat.S_ISLNK(found.st_mode) or not shared)
