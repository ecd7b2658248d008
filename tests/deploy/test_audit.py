"""The audit of dependencies: what it looks at, what it finds, and what it answers where it cannot look. The locks of
images are complete, with exact versions and hashes, and equal to the tested versions."""

import json
import re
import subprocess
from importlib.metadata import requires, version

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from deploy import audit


@pytest.fixture
def root(tmp_path):
    """A project of one requirement, and locks that pin nothing but in one."""
    (tmp_path / "deploy").mkdir()
    (tmp_path / "pyproject.toml").write_text(
        '[build-system]\nrequires = ["setuptools"]\n[project]\ndependencies = ["one>=1.2,<2"]\n'
        '[project.optional-dependencies]\nmore = ["dreamfleet[x]", "Two_2==3.*; python_version < \'4\'"]\n'
    )
    for name in audit.LOCKS:
        (tmp_path / name).write_text("# comment\n")
    (tmp_path / "deploy" / "worker.lock").write_text("three==1.0 ; sys_platform != 'x' \\\n    --hash=sha256:00\n")
    return tmp_path


@pytest.fixture
def copy(tmp_path):
    def write(*advisories):
        path = tmp_path / "advisories.json"
        path.write_text(json.dumps({"date": "2026-01-01", "advisories": advisories}))
        return path

    return write


def advisory(package, introduced, fixed, **more):
    return {"package": package, "id": f"CVE-{package}", "introduced": introduced, "fixed": fixed, **more}


def test_neither_a_floor_nor_a_pin_of_ours_is_known_to_be_vulnerable(capsys, root):
    assert audit.main() == 0, capsys.readouterr().out
    floors = dict(audit.floors(audit.ROOT / "pyproject.toml"))
    assert {"msgpack", "cryptography", "onnx", "starlette", "torch", "setuptools"} <= floors.keys()
    assert all(audit.pins(audit.ROOT / name) for name in audit.LOCKS)
    assert audit.floors(root / "pyproject.toml") == [("one", "1.2"), ("setuptools", "0"), ("two-2", "3")]
    assert audit.pins(root / "deploy" / "worker.lock") == [("three", "1.0")]


@pytest.mark.parametrize(
    ("known", "code"),
    [
        (advisory("one", "0", "1.2.1"), 1),
        (advisory("one", "0", "1.2"), 0),
        (advisory("one", "1.3", "1.4"), 0),
        (advisory("two-2", "0", "3.1"), 1),
        (advisory("setuptools", "0", "1"), 1),  # any version is allowed
        (advisory("three", "0.9", "1.0.1"), 1),
        (advisory("three", "0.9", "1.0.1", accepted="it is not called"), 0),
    ],
)
def test_what_a_vulnerability_concerns(root, copy, known, code, capsys):
    assert audit.main(copy(known), root) == code
    assert (known["id"] in capsys.readouterr().out) == bool(code)


def test_an_audit_that_cannot_look_is_no_success(root, tmp_path):
    path = tmp_path / "advisories.json"
    assert audit.main(path, root) == 2
    for text in ("", "{}", '{"date": "d", "advisories": [{"package": "one"}]}'):
        path.write_text(text)
        assert audit.main(path, root) == 2
    (root / "constraints.txt").unlink()
    assert audit.main(root=root) == 2


def test_what_the_package_index_knows_counts_too(root, copy, monkeypatch, tmp_path, capsys):
    new = {"name": "one", "version": "1.2", "vulns": [{"id": "CVE-new", "fix_versions": ["1.3"]}]}
    answer = tmp_path / "answer.json"
    answer.write_text(json.dumps({"dependencies": [new]}))
    monkeypatch.setattr(audit, "COMMAND", ("-c", "import sys; print(open(sys.argv[1]).read())", answer))
    assert audit.main(copy(), root) == 1
    assert "CVE-new" in capsys.readouterr().out
    accepted = advisory("one", "0", "1.3", id="CVE-new", accepted="it is not called")
    assert audit.main(copy(accepted), root) == 0


DEPLOY = audit.ROOT / "deploy"
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
    assert locked.items() <= pins(audit.ROOT / "constraints.txt").items(), "make lock"
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
    subprocess.run(["make", "sbom"], cwd=audit.ROOT, check=True, capture_output=True)
    document = json.loads((audit.ROOT / "build" / "worker.cdx.json").read_text())
    assert document["metadata"]["component"]["name"] == "dreamfleet"
    found = {canonicalize_name(each["name"]): each["version"] for each in document["components"]}
    assert found == pins(DEPLOY / "worker.lock")
    done = subprocess.run(["make", "audit"], cwd=audit.ROOT, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
