"""The core's tests, which import no add-on and have no mark `add_on`, in a copy of this tree without add-ons.

`make core`, in the environment that `make test` made. `tests/end_to_end/test_run.py` runs a coordinator and a worker
without them.
"""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

from dreamfleet import _HOMES

ROOT = Path(__file__).parents[1]
TESTS = tuple(f"tests/{side}" for side in ("common", "coordinator", "worker"))


def copy_core(tree: Path) -> int:
    """Copy what git knows of, without add-ons and tests that need one; how many modules of tests these are."""
    listed = subprocess.run(("git", "ls-files", "-z"), cwd=ROOT, check=True, capture_output=True, text=True).stdout
    left_out = 0
    for path in (Path(name) for name in listed.split("\0") if name):
        if "addons" in path.parts[1:3] or not (ROOT / path).exists():
            continue
        if path.is_relative_to("tests") and path.suffix == ".py" and needs_add_on(path):
            left_out += path.name.startswith("test_") and str(path).startswith(TESTS)
            continue
        (tree / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / path, tree / path, follow_symlinks=False)
    return left_out


def needs_add_on(path: Path) -> bool:
    """Whether a file of the tests imports an add-on or an experiment, or a file of the tests that does."""
    files, seen = [path], set()
    while files:
        file = files.pop()
        if file in seen or not (ROOT / file).is_file():
            continue
        seen.add(file)
        for name in imported_names(file):
            parts = name.split(".")
            if parts[0] == "dreamfleet" and {"addons", "experiments"} & set(parts):
                return True
            if parts[0] == "tests":
                files.append(Path(*parts).with_suffix(".py"))
    return False


@cache
def imported_names(path: Path) -> set[str]:
    """The modules that a file imports, and what it imports from them, by dotted names."""
    names = set()
    for node in ast.walk(ast.parse((ROOT / path).read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "dreamfleet":
            names |= {f"dreamfleet.{_HOMES.get(alias.name, alias.name)}" for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


def main() -> int:
    """Run them in the copy; their exit status."""
    with tempfile.TemporaryDirectory(prefix="core-") as folder:
        left_out = copy_core(Path(folder))
        print(f"{left_out} modules of the core's tests use an add-on", flush=True)
        marks = "not slow and not long and not add_on"
        command = (sys.executable, "-m", "pytest", "-q", "-m", marks, *TESTS, *sys.argv[1:])
        return subprocess.run(command, cwd=folder, env={**os.environ, "PYTHONPATH": folder}, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
