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

from dreamfleet.common.addons.doctor.health import ROLES, missing_for_role, run_checks
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


@pytest.fixture(scope="module")
def call(tmp_path_factory):
    """Run Python with only the coordinator's packages: links beside an interpreter without packages of its own."""
    folder = tmp_path_factory.mktemp("bare")
    venv.create(folder / "venv", symlinks=True)
    (folder / "site").mkdir()
    for path in (path for name in COORDINATOR for path in top_of(name)):
        (folder / "site" / path.name).symlink_to(path)

    def run(*words, module=("-m", "dreamfleet")):
        seen = {**environment(folder / "cache"), "PYTHONPATH": os.pathsep.join([str(folder / "site"), str(ROOT)])}
        command = [folder / "venv/bin/python", "-P", *module, *words]
        return subprocess.run(command, env=seen, capture_output=True, text=True, check=False, timeout=DEADLINE)

    return run


def test_each_role_is_listed_with_its_remedy(call):
    done = call("doctor")
    assert (done.returncode, done.stderr) == (0, "")
    out = done.stdout
    assert re.search("worker .*gymnasium, onnxruntime", out)
    assert "pip install 'dreamfleet[worker]'" in out
    rows = [line.split() for line in out.splitlines()]
    absent = {row[0] for row in rows if len(row) > 3 and row[2] == "-"}
    assert absent == {"missing"}, "one word, whether a role needs it or not"


@pytest.mark.parametrize(("role", "code"), [("coordinator", 0), ("worker", 1)])
def test_the_exit_code_is_the_chosen_roles(call, role, code):
    done = call("doctor", "--role", role, "--json")
    report = json.loads(done.stdout)
    assert (done.returncode, report["ok"]) == (code, code == 0)
    assert [name for name, is_fit in report["roles"].items() if is_fit] == ["coordinator"]


def test_a_run_that_needs_a_workers_packages_names_the_extra(call, tmp_path):
    done = call("coordinator", "--task", "gym:LunarLander-v3", "--runs-dir", str(tmp_path / "runs"))
    assert done.returncode == 2
    assert re.search(r"'gymnasium'.*dreamfleet\[worker\]", done.stderr)


def test_a_search_does_not_mention_unrequested_pictures(call):
    done = call(module=("-c", "import dreamfleet.coordinator.optimisers.pycma"))
    assert (done.returncode, done.stderr) == (0, "")


def test_a_worker_needs_a_cache_and_no_folder_for_runs(monkeypatch):
    """Its root may be read-only except for the cache."""
    findings = run_checks(Path("/dev/null/runs"))
    assert missing_for_role("worker", findings) == []
    assert [each.name for each in missing_for_role("coordinator", findings)] == ["runs folder"]
    monkeypatch.setenv("DREAMFLEET_CACHE", "/dev/null/cache")
    lacking = {each.name: each.remedy for each in missing_for_role("worker", run_checks(Path("/dev/null/runs")))}
    assert "CACHE" in lacking["bundle able"], "nothing is to be installed again"
    assert "CACHE" in lacking["cache folder"]


def test_a_join_file_is_needed_by_the_two_sides_of_a_fleet_alone(tmp_path):
    (tmp_path / "edited.join").write_text("{}")
    findings = run_checks(tmp_path, tmp_path / "edited.join")
    needing = {role for role in ROLES if any(each.name == "join file" for each in missing_for_role(role, findings))}
    assert needing == {"coordinator", "worker"}
