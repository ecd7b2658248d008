import json
import os

import pytest

from dreamfleet.common.host.trusted_modules import PLACES, VARIABLE, is_trusted, trust, trust_meanwhile
from dreamfleet.common.runs.own_runs import remember_run, trust_own_run

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
    monkeypatch.setattr("sys.path", [each for each in __import__("sys").path if each != str(world)])
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


def test_a_module_in_a_folder_that_others_may_write_or_of_another_place_is_not_trusted(
    world, tmp_path, monkeypatch, caplog
):
    world.chmod(0o777)
    trust_own_run(UID, TASK, OPTIONS)
    assert not is_trusted("my_world")
    assert "--trust" in caplog.text
    world.chmod(0o700)
    (tmp_path / "my_world.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    trust_own_run(UID, TASK, OPTIONS)
    assert not is_trusted("my_world")


def test_what_is_not_trusted_or_cannot_be_written_is_not_remembered(tmp_path, monkeypatch, caplog, ledger):
    ledger.unlink()
    remember_run(UID, TASK, OPTIONS)
    assert not ledger.exists()
    (tmp_path / "taken").write_text("a file")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "taken"))
    trust(["my_world"])
    remember_run(UID, TASK, OPTIONS)
    assert "--trust my_world" in caplog.text
