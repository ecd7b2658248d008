"""The audit of dependencies: what it looks at, what it finds, and what it answers where it cannot look."""

import json

import pytest

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
    """Write a copy of advisories with these."""

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
