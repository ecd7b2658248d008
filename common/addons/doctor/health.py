"""Checks of an installation, each with its remedy. Pages: monitor.md, back-up.md, security.md."""

import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

from dreamfleet.common.addons.task_check.task_check import try_task
from dreamfleet.common.artifacts.bundle_store import CACHE_REMEDY, default_cache, find_bundle, shipped_names
from dreamfleet.common.errors import AccessError, CacheError, DreamfleetError
from dreamfleet.common.files.file_system import file_system_type, is_network, lock_problem
from dreamfleet.common.host.packages import PACKAGES, install_command, package_version, wrong_version
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.security.credentials import EXPIRY_WARNING, describe_time_left, read_join_file
from dreamfleet.common.security.handshake import check_certificate

GROUP = "dreamfleet.checks"
# The `Finding.role`s that each role needs. The extra of the last one's name installs it, except for the coordinator.
ROLES = {
    "coordinator": ("everything", "fleet", "coordinator"),
    "worker": ("everything", "fleet", "worker"),
    "views": ("everything", "worker", "views"),
    "train": ("everything", "worker", "train"),
    "dashboard": ("everything", "dashboard"),
    "export": ("everything", "export"),
}
SPARED = ("box2d", "pygame-ce")  # without them our native module drives and draws CarRacing
ABSENT = "-"  # what is found of a thing that is missing
MIN_FREE_BYTES = 200_000_000


@dataclass(frozen=True)
class Finding:
    """The result of one check; `role` is one of `ROLES` or of what they need, `needed` whether it requires it."""

    name: str
    ok: bool
    needed: bool
    found: str
    role: str
    remedy: str


def run_checks(runs_dir: Path, join: Path | None = None, task: str | None = None) -> list[Finding]:
    """Run all checks: of this module, of the join file and the task if any, and those in the entry points `GROUP`."""
    registered = [finding for point in entry_points(group=GROUP) for finding in point.load()()]
    cache = _check_writable("cache", default_cache(), "everything")
    runs = _check_writable("runs", runs_dir, "coordinator")
    joined = [] if join is None else [_check_join_file(join)]
    tried = [] if task is None else _check_task(task)
    return [*_check_packages(), _check_box2d(), *_check_bundles(), *registered, cache, runs, *joined, *tried]


def _check_task(task: str) -> Iterator[Finding]:
    found, name = try_task(task, {}), f"task {task}"
    if found.fault:
        yield Finding(name, False, True, found.fault, "worker", shell_command("tasks", task))
        return
    remedy = "recomputed results are not bit-identical until that is fixed"
    text = "; ".join([found.varies or "can be scored", *found.warnings])
    yield Finding(name, not found.varies, False, text, "worker", remedy)


def _check_join_file(path: Path) -> Finding:
    """Whether a join file is valid; not ok within `EXPIRY_WARNING` of its end."""
    try:
        credentials = read_join_file(path)
        check_certificate(credentials)
    except AccessError as error:
        return Finding("join file", False, True, str(error), "fleet", "have another issued")
    left = credentials.time_left
    found = f"{path}: {credentials.role} {credentials.name}, {describe_time_left(left)}"
    remedy = f"have {credentials.role} {credentials.name} issued again"
    return Finding("join file", left > EXPIRY_WARNING, False, found, "fleet", remedy)


def missing_for_role(role: str, findings: list[Finding]) -> list[Finding]:
    """The failed checks that a role requires; empty if this installation can take the role."""
    return [each for each in findings if each.role in ROLES[role] and each.needed and not each.ok]


def _check_packages() -> Iterator[Finding]:
    for name, (module, extra) in PACKAGES.items():
        found = package_version(name) or (package_version("box2d-py") if name == "box2d" else None)
        wrong = wrong_version(name)
        ok = found is not None and find_spec(module) is not None and not wrong
        needed = not extra or (extra in ROLES and name not in SPARED)  # other extras are of single tasks
        yield Finding(name, ok, needed, found or ABSENT, extra or "everything", wrong or install_command(extra))


def _check_box2d() -> Finding:
    both = package_version("box2d") and package_version("box2d-py")
    remedy = "pip uninstall box2d box2d-py, then pip install 'dreamfleet[worker]': both own the module Box2D"
    return Finding("one Box2D", not both, True, "both box2d and box2d-py" if both else "ok", "worker", remedy)


def _check_bundles() -> Iterator[Finding]:
    names = shipped_names()
    for name in names:
        remedy = "reinstall dreamfleet"
        try:
            found, ok = find_bundle(name).sha256[:12], True
        except CacheError as error:  # it ships in parts, which are put together there
            found, ok, remedy = str(error), False, CACHE_REMEDY
        except DreamfleetError as error:
            found, ok = str(error), False
        yield Finding(f"bundle {name}", ok, True, found, "everything", remedy)
    if not names:
        yield Finding("bundle", False, True, ABSENT, "everything", "reinstall dreamfleet")


def _check_writable(name: str, path: Path, role: str) -> Finding:
    """Whether a folder, or its nearest existing parent, is writable and has room."""
    where = next(each for each in (path, *path.absolute().parents) if each.exists())
    remedy = f"make {where} writable, or point $DREAMFLEET_{'CACHE' if name == 'cache' else 'RUNS_DIR'} elsewhere"
    try:
        with tempfile.TemporaryFile(dir=where):
            free = shutil.disk_usage(where).free
    except OSError as error:
        return Finding(f"{name} folder", False, True, f"{path}: {error.strerror}", role, remedy)
    if name == "runs" and (problem := lock_problem(where)):
        return Finding("runs folder", False, True, problem, role, "point $DREAMFLEET_RUNS_DIR to a local disk")
    found = f"{path}, {free / 1e9:.1f} GB free"
    if name == "runs" and is_network(kind := file_system_type(where)):
        found += f", on a network file system ({kind})"
    return Finding(f"{name} folder", free > MIN_FREE_BYTES, True, found, role, remedy)
