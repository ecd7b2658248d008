"""Tests own_modules.py and common/runs/own_runs.py."""

import json
import os
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

from dreamfleet.common.addons.own_modules import trust_own_run
from dreamfleet.common.host.trusted_modules import PLACES, VARIABLE, is_trusted, trust, trust_meanwhile
from dreamfleet.common.runs.own_runs import remember_run

UID, TASK, OPTIONS = "0123456789abcdef" * 2, "gym:my_world:Catch-v0", '{"hard": true}'


@pytest.fixture(autouse=True)
def world(tmp_path, monkeypatch):
    """The folder of a module `my_world`, which nothing trusts, and which this process finds."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.delenv(PLACES, raising=False)
    folder = tmp_path / "worlds"
    folder.mkdir(mode=0o700)
    (folder / "my_world.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(folder)
    trust(["my_world"])
    remember_run(UID, TASK, OPTIONS)
    monkeypatch.delenv(VARIABLE)
    return folder


@pytest.fixture
def ledger(tmp_path):
    return tmp_path / "state" / "dreamfleet" / "own-runs" / UID


def test_a_run_begun_here_has_its_module_trusted_and_found(world, monkeypatch, ledger):
    assert json.loads(ledger.read_text()) == [TASK, OPTIONS, str(world)]
    monkeypatch.setattr("sys.path", [each for each in sys.path if each != str(world)])
    trust_own_run(UID, TASK, OPTIONS)
    assert is_trusted("my_world")
    assert os.environ[PLACES] == str(world)


def test_what_one_evaluation_needs_is_not_trusted_by_later_processes():
    trust(["other"])
    with trust_meanwhile():
        trust_own_run(UID, TASK, OPTIONS)
        assert is_trusted("my_world")
    assert not is_trusted("my_world")
    assert os.environ[VARIABLE] == "other"


@pytest.mark.parametrize(("uid", "task", "options"), [
    (UID, "gym:my_world:Other-v0", OPTIONS), (UID, TASK, ""), ("f" * 32, TASK, OPTIONS), (None, TASK, OPTIONS),
    (7, TASK, OPTIONS), (f"../own-runs/{UID}", TASK, OPTIONS), (UID, "gym:CartPole-v1", OPTIONS),
])  # fmt: skip
def test_no_file_chooses_a_module_by_naming_another_run_task_or_option(uid, task, options):
    trust_own_run(uid, task, options)
    assert not is_trusted("my_world")


TEXTS = "5", "null", "[]", '["gym:my_world:Catch-v0"]', "[", "\x00", '["a", "b", "c", "d"]'


@pytest.mark.parametrize("harm", [
    *(lambda ledger, text=text: ledger.write_text(text) for text in TEXTS),
    lambda ledger: ledger.parent.chmod(0o777),
    lambda ledger: (ledger.unlink(), os.mkfifo(ledger)),
])  # fmt: skip
def test_a_ledger_that_is_damaged_or_that_others_may_write_trusts_nothing(harm, ledger):
    harm(ledger)
    trust_own_run(UID, TASK, OPTIONS)
    assert not is_trusted("my_world")


def test_a_module_of_another_place_is_not_trusted(tmp_path, monkeypatch, caplog):
    (tmp_path / "my_world.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    trust_own_run(UID, TASK, OPTIONS)
    assert not is_trusted("my_world")
    assert "--trust" in caplog.text


@pytest.fixture
def package(world, monkeypatch):
    """The folder of a package `my_package`, in whose module `inner` a run began: the uid and task of that run."""
    folder = world / "my_package"
    for each in (".", "inner", "__pycache__"):
        (folder / each).mkdir()
    for each in (
        "__init__.py",
        "inner/__init__.py",
        "helper.py",
        f"__pycache__/helper.{sys.implementation.cache_tag}.pyc",
    ):
        (folder / each).write_text("raise SystemExit('imported')\n")
    (folder / "inner" / "link.py").symlink_to(folder / "helper.py")
    (folder / "inner" / "loop").symlink_to(folder)
    trust(["my_package"])
    remember_run("f" * 32, "gym:my_package.inner:Catch-v0", "")
    monkeypatch.delenv(VARIABLE)
    return folder


def trusts_package():
    trust_own_run("f" * 32, "gym:my_package.inner:Catch-v0", "")
    return is_trusted("my_package.inner")


def test_a_package_that_nobody_else_may_change_is_trusted(package):
    assert trusts_package()


@pytest.mark.parametrize("mode", [0o002, 0o1002])
@pytest.mark.parametrize("place", [
    "..", ".", "inner", "__init__.py", "inner/__init__.py", "helper.py", "__pycache__",
    f"__pycache__/helper.{sys.implementation.cache_tag}.pyc",
])  # fmt: skip
def test_a_package_of_which_others_may_change_a_folder_or_file_is_not_trusted(package, place, mode, caplog):
    found = (package / place).resolve()
    found.chmod(found.stat().st_mode | mode)
    assert not trusts_package()
    assert str(found) in caplog.text


@pytest.mark.parametrize(("mode", "trusted"), [(0o777, False), (0o1777, True), (0o755, True)])
def test_a_folder_above_that_others_may_write_must_be_sticky(package, tmp_path, mode, trusted):
    tmp_path.chmod(mode)
    assert trusts_package() is trusted


@pytest.mark.parametrize("linked", ["elsewhere", "elsewhere/more.py"])
@pytest.mark.parametrize(("mode", "trusted"), [(0o600, True), (0o666, False)])
def test_of_a_link_what_it_names_must_be_the_users_too(package, tmp_path, linked, mode, trusted):
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    (tmp_path / "elsewhere" / "more.py").touch(mode)
    (tmp_path / "elsewhere" / "more.py").chmod(mode)
    (package / "inner" / Path(linked).name).symlink_to(tmp_path / linked)
    assert trusts_package() is trusted


def test_a_module_in_an_archive_needs_the_archive(tmp_path, monkeypatch):
    with ZipFile(archive := tmp_path / "archive.zip", "w") as file:
        file.writestr("packed.py", "")
    monkeypatch.syspath_prepend(archive)
    trust(["packed"])
    remember_run(UID, "gym:packed:Catch-v0", "")
    monkeypatch.delenv(VARIABLE)
    archive.chmod(0o606)
    trust_own_run(UID, "gym:packed:Catch-v0", "")
    assert not is_trusted("packed")
    archive.chmod(0o600)
    trust_own_run(UID, "gym:packed:Catch-v0", "")
    assert is_trusted("packed")


@pytest.mark.parametrize("name", ["my_world.py", "beside.py"])
@pytest.mark.parametrize("harm", [lambda file: file.chmod(0o666), lambda file: give_away(file, 65534, 65534)])
def test_a_module_without_a_package_needs_its_file_and_those_beside_it(world, name, harm):
    (world / name).write_text("")
    harm(world / name)
    trust_own_run(UID, TASK, OPTIONS)
    assert not is_trusted("my_world")


@pytest.mark.parametrize("place", ["helpers", "helpers/__init__.py", "helpers/deep", "helpers/deep/more.py"])
@pytest.mark.parametrize(("mode", "trusted"), [(0o022, True), (0o002, False)])
def test_a_package_beside_a_module_must_be_the_users_too(world, place, mode, trusted):
    (world / "helpers" / "deep").mkdir(parents=True)
    for each in ("__init__.py", "deep/more.py"):
        (world / "helpers" / each).touch()
    (world / place).chmod((world / place).stat().st_mode & ~mode | (0 if trusted else mode))
    trust_own_run(UID, TASK, OPTIONS)
    assert is_trusted("my_world") is trusted


def test_folders_that_no_import_can_name_are_not_looked_at(world):
    for name in (".git", "python3.11"):
        (world / name).mkdir()
        (world / name).chmod(0o777)
        (world / name / "code.py").touch()
    trust_own_run(UID, TASK, OPTIONS)
    assert is_trusted("my_world")


@pytest.mark.parametrize(("mode", "trusted"), [(0o777, False), (0o755, True)])
@pytest.mark.parametrize("step", ["link.py", "inner/link.py"])
def test_each_link_of_a_chain_must_lie_where_only_the_user_writes(world, tmp_path, mode, trusted, step):
    (tmp_path / "between" / "inner").mkdir(parents=True)
    (tmp_path / "safe.py").touch()
    (tmp_path / "between" / step).symlink_to(tmp_path / "safe.py")
    (tmp_path / "last").symlink_to("between")
    (world / "beside.py").symlink_to(Path("..", "last", "inner", "..", step))
    (tmp_path / "between").chmod(mode)
    trust_own_run(UID, TASK, OPTIONS)
    assert is_trusted("my_world") is trusted


@pytest.mark.parametrize("there", [True, False])
def test_in_a_sticky_folder_a_link_must_be_the_users_and_name_what_exists(world, tmp_path, there):
    (shared := tmp_path / "shared").mkdir()
    shared.chmod(0o1777)
    if there:
        (shared / "more.py").touch()
    (world / "beside.py").symlink_to(shared / "more.py")
    trust_own_run(UID, TASK, OPTIONS)
    assert is_trusted("my_world") is there


def test_a_link_of_another_user_in_a_sticky_folder_is_not_followed(world, tmp_path):
    (shared := tmp_path / "shared").mkdir()
    shared.chmod(0o1777)
    (tmp_path / "safe.py").touch()
    (shared / "link.py").symlink_to(tmp_path / "safe.py")
    (world / "beside.py").symlink_to(shared / "link.py")
    give_away(shared / "link.py", 65534, -1)
    trust_own_run(UID, TASK, OPTIONS)
    assert not is_trusted("my_world")


@pytest.mark.parametrize("private", [True, False])
def test_a_group_may_write_only_if_it_is_the_users_private_one(world, monkeypatch, private):
    group = os.geteuid() if private else os.geteuid() + 1
    monkeypatch.setattr(os, "getegid", lambda: group)
    (world / "my_world.py").chmod(0o664)
    if (world / "my_world.py").stat().st_gid != group:
        give_away(world / "my_world.py", -1, group)
    trust_own_run(UID, TASK, OPTIONS)
    assert is_trusted("my_world") is private


def give_away(path, owner, group):
    try:
        os.chown(path, owner, group, follow_symlinks=False)
    except PermissionError:
        pytest.skip("only root gives a file away")


def test_what_is_not_trusted_or_cannot_be_written_is_not_remembered(tmp_path, monkeypatch, caplog, ledger):
    ledger.unlink()
    remember_run(UID, TASK, OPTIONS)
    assert not ledger.exists()
    (tmp_path / "taken").write_text("a file")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "taken"))
    trust(["my_world"])
    remember_run(UID, TASK, OPTIONS)
    assert "--trust my_world" in caplog.text
