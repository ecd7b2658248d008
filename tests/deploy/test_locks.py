"""The locks of images: complete, with exact versions and hashes, and equal to the tested versions."""

import json
import re
import subprocess
from importlib.metadata import requires, version
from pathlib import Path

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from deploy import audit

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
PIN = re.compile(r"^([A-Za-z0-9._-]+)==([^ ;\\]+)")


def pins(path):
    return dict(audit.pins(path))


def closure(name, extras=()):
    """A distribution and all that it depends on here: requirements by name."""
    seen, waiting = {}, [(name, frozenset(extras))]
    while waiting:
        name, extras = waiting.pop()
        for text in requires(name) or ():
            wanted = Requirement(text)
            under = [{**default_environment(), "extra": each} for each in (extras or {""})]
            if wanted.marker is not None and not any(wanted.marker.evaluate(each) for each in under):
                continue
            key = canonicalize_name(wanted.name)
            if key not in seen and key != "dreamfleet":
                waiting.append((key, frozenset(wanted.extras)))
            seen.setdefault(key, []).append(wanted.specifier)
    return seen


@pytest.mark.parametrize(("name", "extras"), [("coordinator", ()), ("worker", ("worker",))])
def test_a_lock_holds_all_that_its_role_needs_in_the_versions_that_are_tested(name, extras):
    locked = pins(DEPLOY / f"{name}.lock")
    assert locked.items() <= pins(ROOT / "constraints.txt").items(), "make lock"
    assert locked["numpy"] == version("numpy")
    needed = closure("dreamfleet", extras)
    assert locked.keys() == needed.keys(), "write it again: make lock"
    for key, specifiers in needed.items():
        assert all(locked[key] in each for each in specifiers), f"{key}: make lock"


@pytest.mark.parametrize("name", ["build", "coordinator", "worker"])
def test_a_lock_has_hashes_and_names_no_place(name):
    text = (DEPLOY / f"{name}.lock").read_text()
    for entry in re.split(r"\n(?=\S)", text)[1:]:
        assert PIN.match(entry), entry
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", entry), entry
    assert "/" not in text.replace("deploy/", "")


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_the_bill_of_materials_is_the_lock_and_the_audit_finds_nothing():
    subprocess.run(["make", "sbom"], cwd=ROOT, check=True, capture_output=True)
    document = json.loads((ROOT / "build" / "worker.cdx.json").read_text())
    assert document["metadata"]["component"]["name"] == "dreamfleet"
    found = {canonicalize_name(each["name"]): each["version"] for each in document["components"]}
    assert found == pins(DEPLOY / "worker.lock")
    done = subprocess.run(["make", "audit"], cwd=ROOT, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
