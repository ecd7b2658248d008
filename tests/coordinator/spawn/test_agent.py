"""The agent on hosts in unexpected states."""

import os

import pytest

from dreamfleet.coordinator.spawn import agent
from dreamfleet.coordinator.spawn.agent import COMPLETE, MARK, Channel, HostFolder


def test_a_missing_file_is_reported_and_the_lock_released(tmp_path, capsys):
    asked = {"do": "start", "root": str(tmp_path / "place"), "name": "box", "python": str(tmp_path / "gone"),
             "words": [], "env": {}, "slots": 1, "held": False, "digest": "1"}  # fmt: skip
    for _ in range(2):
        agent.handle_request(asked, Channel())
        said = capsys.readouterr().out
        assert said.startswith(f'{MARK}{{"failed"'), said
        assert "No such file" in said


def test_a_folder_removed_while_waiting_for_its_lock_is_created_again(tmp_path, monkeypatch):
    host_folder, take = HostFolder(str(tmp_path / "place"), Channel()), HostFolder._acquire

    def removed(self, lock):
        monkeypatch.setattr(HostFolder, "_acquire", take)
        self.remove()
        take(self, lock)

    monkeypatch.setattr(HostFolder, "_acquire", removed)
    with host_folder.locked():
        assert (host_folder.root / "lock").exists()


def test_a_foreign_folder_is_left_alone(tmp_path, capsys):
    kept = [tmp_path / "cache" / "a", tmp_path / "workers" / "mine" / "b", tmp_path / "environments" / "c"]
    for path in kept:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    agent.handle_request({"do": "end", "root": str(tmp_path), "names": None, "now": False, "keep": False}, Channel())
    assert '"ok"' in capsys.readouterr().out
    agent.handle_request({"do": "start", "root": str(tmp_path), "name": "box"}, Channel())
    assert "of something else: name another --remote-dir" in capsys.readouterr().out
    assert all(path.exists() for path in kept)


def test_a_folder_that_existed_before_stays_with_its_other_files(tmp_path):
    host_folder = HostFolder(str(tmp_path), Channel())
    (tmp_path / "notes").touch()
    with host_folder.locked():
        (tmp_path / "cache").mkdir()
    with host_folder.locked():
        host_folder.remove()
    assert [path.name for path in tmp_path.iterdir()] == ["notes"]


@pytest.mark.parametrize("there", [True, False])
def test_an_environment_without_its_python_is_not_listed(tmp_path, there):
    folder = tmp_path / "environments" / "one"
    (folder / "bin").mkdir(parents=True)
    (folder / COMPLETE).touch()
    (folder / "bin" / "python").symlink_to(os.devnull if there else tmp_path / "gone")
    found = agent.inspect_host(HostFolder(str(tmp_path), Channel()))
    assert found["environments"] == (["one"] if there else [])
