"""`doctor` in an installation with only a coordinator's packages, built from links.
Tests common/addons/doctor/health.py, common/addons/doctor/verb.py and worker/addons/health.py."""

import json
import os
import re
import subprocess
import venv
from importlib.metadata import distribution
from pathlib import Path

import pytest

from dreamfleet.common.addons.doctor.health import missing_for_role, run_checks
from tests.support.processes import DEADLINE, ROOT, environment

COORDINATOR = (
    "cma", "cmaes", "eclipse-zenoh", "msgpack", "msgspec", "numpy", "prometheus-client", "psutil", "rich",
    "pygments", "markdown-it-py", "mdurl", "dreamfleet",
)  # fmt: skip


def top_of(name):
    found = distribution(name)
    files = found.files or []
    tops = {file.parts[0] for file in files if ".." not in file.parts and not file.parts[0].startswith("__")}
    return [found.locate_file(top) for top in tops]


@pytest.fixture
def bare(tmp_path):
    """A folder of links to only the coordinator's packages, beside an interpreter that has no packages of its own."""
    venv.create(tmp_path / "venv", symlinks=True)
    site = tmp_path / "site"
    site.mkdir()
    for name in COORDINATOR:
        for path in top_of(name):
            (site / path.name).symlink_to(path)
    return site


def call(bare, tmp_path, *words, module=("-m", "dreamfleet")):
    seen = {**environment(tmp_path / "cache"), "PYTHONPATH": os.pathsep.join([str(bare), str(ROOT)])}
    command = [bare.parent / "venv/bin/python", "-P", *module, *words]
    return subprocess.run(command, env=seen, capture_output=True, text=True, check=False, timeout=DEADLINE)


def doctor(bare, tmp_path, *words):
    done = call(bare, tmp_path, "doctor", *words)
    assert not done.stderr, done.stderr
    return done.returncode, done.stdout


def test_each_role_is_listed_with_its_remedy(bare, tmp_path):
    code, out = doctor(bare, tmp_path)
    assert code == 0
    assert re.search("worker .*gymnasium, pygame-ce, box2d, onnxruntime", out)
    assert "pip install 'dreamfleet[worker]'" in out
    rows = [line.split() for line in out.splitlines()]
    absent = {row[0] for row in rows if len(row) > 3 and row[2] == "-"}
    assert absent == {"missing"}, "one word, whether a role needs it or not"


@pytest.mark.parametrize(
    ("role", "code"), [("coordinator", 0), ("worker", 1), ("views", 1), ("train", 1), ("dashboard", 1), ("export", 1)]
)
def test_the_exit_code_is_the_chosen_roles(bare, tmp_path, role, code):
    left, out = doctor(bare, tmp_path, "--role", role, "--json")
    report = json.loads(out)
    assert left == code
    assert report["ok"] is (code == 0)
    assert report["roles"]["coordinator"]
    assert not report["roles"]["worker"]


def test_a_run_that_needs_a_workers_packages_names_the_extra(bare, tmp_path):
    done = call(bare, tmp_path, "coordinator", "--task", "gym:LunarLander-v3", "--runs-dir", str(tmp_path / "runs"))
    assert done.returncode == 2
    assert re.search(r"'gymnasium'.*dreamfleet\[worker\]", done.stderr)


def test_a_search_does_not_mention_unrequested_pictures(bare, tmp_path):
    done = call(bare, tmp_path, module=("-c", "import dreamfleet.coordinator.optimisers.pycma"))
    assert (done.returncode, done.stderr) == (0, "")


def test_a_worker_needs_no_folder_for_runs():
    """Its root may be read-only except for the cache."""
    findings = run_checks(Path("/dev/null/runs"))
    assert missing_for_role("worker", findings) == []
    assert [each.name for each in missing_for_role("coordinator", findings)] == ["runs folder"]


def test_what_only_the_cache_keeps_from_being_assembled_is_not_to_be_reinstalled(monkeypatch):
    monkeypatch.setenv("DREAMFLEET_CACHE", "/dev/null/cache")
    lacking = {each.name: each.remedy for each in run_checks(Path("/dev/null/runs")) if not each.ok and each.needed}
    assert "CACHE" in lacking["bundle able"]
    assert "CACHE" in lacking["cache folder"]
