"""The agent on hosts in unexpected states."""

import errno
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
from contextlib import nullcontext

import pytest

from dreamfleet.coordinator.addons.spawn import agent
from dreamfleet.coordinator.addons.spawn.agent import COMPLETE, CREATED, FOLDERS, MARK, STATE, Channel, HostFolder
from tests.support.processes import ROOT, ends


def answer(asked, capsys):
    agent.handle_request(asked, Channel())
    return json.loads(capsys.readouterr().out.splitlines()[-1].removeprefix(MARK))


def ending(asked):
    return {"do": "end", "root": str(asked["root"]), "names": None, "now": True, "keep": False}


def test_a_missing_file_is_reported_and_the_lock_released(tmp_path, capsys):
    asked = {"do": "start", "root": str(tmp_path / "place"), "name": "box", "python": str(tmp_path / "gone"),
             "words": [], "env": {}, "slots": 1, "held": False, "digest": "1"}  # fmt: skip
    for _ in range(2):
        assert "No such file" in answer(asked, capsys)["failed"]


def remove_meanwhile(monkeypatch):
    """Somebody removes the folder while the next who locks it waits."""
    take = HostFolder._acquire

    def removed(self, lock):
        monkeypatch.setattr(HostFolder, "_acquire", take)
        self.remove()
        take(self, lock)

    monkeypatch.setattr(HostFolder, "_acquire", removed)


def test_a_folder_removed_while_waiting_for_its_lock_is_created_again(tmp_path, monkeypatch):
    host_folder = HostFolder(str(tmp_path / "place"), Channel())
    remove_meanwhile(monkeypatch)
    with host_folder.locked():
        assert (host_folder.root / "lock").exists()


@pytest.mark.parametrize(
    "names",
    [("cache/a", "workers/mine/b", "environments/c"), ("made", "cache/a"), ("lock",), ("workers/mine/worker.json",)],
)
def test_a_foreign_folder_is_left_alone(tmp_path, capsys, names):
    kept = [tmp_path / name for name in names]
    for path in kept:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    said = answer(ending({"root": tmp_path}), capsys)
    assert "rm -rf" in said["failed"] if "made" in names else said["ok"] == {"ended": [], "stay": []}
    assert "--remote-dir" in answer({"do": "start", "root": str(tmp_path), "name": "box"}, capsys)["failed"]
    assert all(path.exists() for path in kept)


def give_away(path):
    try:
        os.chown(path, 65534, -1, follow_symlinks=False)
    except PermissionError:
        pytest.skip("only root gives a file away")


def of_another_group(path):
    path.chmod(0o775)
    if path.stat().st_gid == os.geteuid():
        try:
            os.chown(path, -1, os.geteuid() + 1)
        except PermissionError:
            pytest.skip("only root gives a file to any group")


def link_instead(path):
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


@pytest.mark.parametrize("place", [".", *FOLDERS, CREATED, "lock"])
@pytest.mark.parametrize("harm", [lambda path: path.chmod(0o777), of_another_group, give_away, link_instead])
@pytest.mark.parametrize("do", ["look", "start", "follow", "end"])
def test_a_folder_that_others_may_change_is_neither_used_nor_removed(tmp_path, capsys, place, harm, do):
    root = tmp_path / "place"
    with HostFolder(str(root), Channel()).locked():
        (root / "workers" / "box").mkdir()
        (root / "workers" / "box" / "log").touch()
    harm(root / place)
    asked = {**ending({"root": root}), "do": do, "name": "box", "words": [], "held": False}
    before = sorted(tmp_path.rglob("*"))
    if harm is link_instead and place == ".":  # this user's own, as to a larger disk
        assert "ok" in answer({**asked, "do": "look"}, capsys)
    else:
        assert "--remote-dir" in answer(asked, capsys)["failed"]
    assert sorted(tmp_path.rglob("*")) == before


def test_a_link_of_another_user_is_no_folder(tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    (tmp_path / "place").symlink_to("mine")
    give_away(tmp_path / "place")
    assert "--remote-dir" in answer(ending({"root": tmp_path / "place"}), capsys)["failed"]


def test_a_folder_that_another_user_makes_meanwhile_takes_no_worker(tmp_path, capsys, monkeypatch):
    enter = HostFolder._enter

    def others_first(self):
        self.root.mkdir()
        self.root.chmod(0o777)
        return enter(self)

    monkeypatch.setattr(HostFolder, "_enter", others_first)
    asked = {"do": "start", "root": str(tmp_path / "place"), "name": "box"}
    assert "--remote-dir" in answer(asked, capsys)["failed"]
    assert not (tmp_path / "place" / "workers").exists()


def test_a_private_group_may_write_to_the_folder(tmp_path, capsys):
    tmp_path.chmod(0o775)
    try:
        os.chown(tmp_path, -1, os.geteuid())
    except PermissionError:
        pytest.skip("this user has no private group")
    assert "ok" in answer({"do": "look", "root": str(tmp_path)}, capsys)


@pytest.mark.parametrize("root", ["~", "~/below/..", "~/..", "~nosuchuser/x"])
def test_a_home_or_a_folder_above_it_takes_no_worker(tmp_path, capsys, monkeypatch, root):
    home = tmp_path / "me"
    (home / "below").mkdir(parents=True)
    monkeypatch.setenv("HOME", str(home))
    assert "--remote-dir" in answer({"do": "start", "root": root, "name": "box"}, capsys)["failed"]
    assert [*tmp_path.rglob("*")] == [home, home / "below"]


def test_a_removal_that_was_interrupted_at_its_last_step_is_finished(tmp_path, capsys):
    host_folder = HostFolder(str(tmp_path / "place"), Channel())
    with host_folder.locked():
        pass
    for name in FOLDERS:
        (host_folder.root / name).rmdir()
    (host_folder.root / CREATED).unlink()
    assert answer(ending({"root": host_folder.root}), capsys)["ok"] == {"ended": [], "stay": []}
    assert not host_folder.root.exists()


def test_an_end_that_waited_for_a_removal_leaves_nothing(tmp_path, monkeypatch, capsys):
    host_folder = HostFolder(str(tmp_path / "place"), Channel())
    with host_folder.locked():
        pass
    remove_meanwhile(monkeypatch)
    assert answer({**ending({"root": host_folder.root}), "keep": True}, capsys)["ok"] == {"ended": [], "stay": []}
    assert not host_folder.root.exists()


def test_folders_that_two_commands_make_at_once_are_all_listed_and_removed(tmp_path, capsys):
    host_folder, other = (HostFolder(str(tmp_path / "share" / "fleet"), Channel()) for _ in range(2))
    lock, made, ours = host_folder._enter()
    with lock, other.locked():  # which found the folder made, and was the first to lock it
        pass
    host_folder._record(made, ours)
    assert "ok" in answer(ending({"root": host_folder.root}), capsys)
    assert [*tmp_path.iterdir()] == []


def test_a_folder_that_existed_before_stays_with_its_other_files(tmp_path):
    host_folder = HostFolder(str(tmp_path), Channel())
    (tmp_path / "notes").touch()
    with host_folder.locked():
        (tmp_path / "cache" / "model").touch()
    with host_folder.locked():
        host_folder.remove()
    assert [path.name for path in tmp_path.iterdir()] == ["notes"]


@pytest.mark.parametrize("there", [True, False])
def test_an_environment_without_its_python_is_not_listed(tmp_path, there):
    folder = tmp_path / "environments" / "one"
    (folder / "bin").mkdir(parents=True)
    (folder / COMPLETE).touch()
    (folder / "bin" / "python").symlink_to(os.devnull if there else tmp_path / "gone")
    found = agent.inspect_host(HostFolder(str(tmp_path), Channel()), {})
    assert found["environments"] == (["one"] if there else [])


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["killed", "full"])
def test_an_agent_that_ends_at_any_step_leaves_what_the_next_one_removes(tmp_path, mode):
    words = [sys.executable, ROOT / "tests" / "support" / "agent_steps.py", tmp_path, mode]
    done = subprocess.run(words, capture_output=True, check=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(found) > 15
    assert {each["code"] for each in found[:-1]} == {9 if mode == "killed" else 8}
    assert [each for each in found if not each["ok"] or each["lives"]] == []
    # Killed between creating a folder and listing it, an agent leaves it empty: it may have been there before.
    empty = [["share"], ["share", "share/fleet"]]
    assert [each["left"] for each in found if each["left"] and (mode == "full" or each["left"] not in empty)] == []


HOLDER = b'{"pid": 1, "birth": "", "node": "", "digest": "", "slots": 1, "since": 1.0, "holder": "oops"}'


@pytest.mark.parametrize("damage", [b"", b"{", b"7", b'"x"', b"[1, [2]]", b'["/"]', HOLDER])
def test_damaged_files_of_the_agent_are_read_as_nothing(tmp_path, capsys, damage):
    root = tmp_path / "place"
    host_folder = HostFolder(str(root), Channel())
    with host_folder.locked():
        host_folder.worker("box").mkdir(parents=True)
    (root / CREATED).write_bytes(damage)
    (host_folder.worker("box") / STATE).write_bytes(damage)
    (root / "workers" / ".DS_Store").touch()
    assert agent.inspect_host(host_folder, {})["workers"][0]["running"] is False
    if damage == b'["/"]':  # as the agent writes it
        assert "ok" in answer(ending({"root": root}), capsys)
    else:  # it may be somebody's own
        said = answer(ending({"root": root}), capsys)["failed"]
        subprocess.run(said[said.index("cd ") :], shell=True, check=True)
    assert not any(root.glob("*"))


def test_what_cannot_be_removed_stays_ours_and_is_named_with_the_command(tmp_path, monkeypatch, capsys):
    host_folder, remove = HostFolder(str(tmp_path / "place"), Channel()), shutil.rmtree
    asked = ending({"root": host_folder.root})
    with host_folder.locked():
        (host_folder.environment("one") / "lib").mkdir(parents=True)
    (host_folder.environment("one") / "lib").chmod(0o500)

    def refused(folder):
        raise PermissionError(13, os.strerror(13), str(folder))

    monkeypatch.setattr(shutil, "rmtree", refused)
    assert f"cd {host_folder.root} && rm -rf environments" in answer(asked, capsys)["failed"]
    assert host_folder.is_ours
    monkeypatch.setattr(shutil, "rmtree", remove)
    answer(asked, capsys)
    assert not host_folder.root.exists()


@pytest.fixture
def started(tmp_path):
    """A request to start a worker, the folder in which it runs already, and its process id."""
    host_folder = HostFolder(str(tmp_path / "place"), Channel())
    folder = host_folder.worker("box")
    with host_folder.locked():
        folder.mkdir(parents=True)
    words = [sys.executable, "-c", "import time; time.sleep(1000)", "worker"]
    child = subprocess.Popen(words, cwd=folder, start_new_session=True)
    state = {"digest": "1", "slots": 1, "since": 0.0, "node": platform.node(), "pid": child.pid,
             "birth": agent.process_start(child.pid)}  # fmt: skip
    (folder / STATE).write_text(json.dumps(state))
    yield {"do": "start", "root": str(host_folder.root), "name": "box", "held": False, "digest": "1"}, folder, child.pid
    child.kill()
    child.wait()


def test_a_worker_by_a_tunnel_ends_with_an_agent_that_is_killed(tmp_path):
    program = (
        "import os, signal; open(os.environ['DREAMFLEET_REPORTS'], 'w').write('{\"begun\": 1}'); "
        "print('here', flush=True); signal.pause()"
    )
    asked = {"do": "start", "root": str(tmp_path / "place"), "name": "box", "python": sys.executable, "held": True,
             "words": ["-c", program, "worker"], "env": {}, "digest": "1", "slots": 1}  # fmt: skip
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, agent.__file__], stdin=pipe, stdout=pipe, text=True) as killed:
        print(json.dumps(asked), file=killed.stdin, flush=True)
        said = (json.loads(each.removeprefix(MARK)) for each in killed.stdout if each.startswith(MARK))
        assert next(each["ok"] for each in said if each.get("ok"))["running"]
        state = json.loads((tmp_path / "place" / "workers" / "box" / STATE).read_text())
        worker = os.pidfd_open(state["pid"])
        killed.kill()
    assert ends(worker)


def test_a_worker_is_this_hosts_after_the_host_is_renamed(started, capsys, monkeypatch):
    asked, folder, pid = started
    monkeypatch.setattr(platform, "node", lambda: "renamed")
    assert answer(asked, capsys)["ok"]["outcome"] == "running"
    others = {**ending(asked), "names": ["another"]}
    assert answer(others, capsys)["ok"] == {"ended": [], "stay": [asked["name"]]}
    assert [each["running"] for each in answer(ending(asked), capsys)["ok"]["ended"]] == [True]
    assert agent.process_start(pid) == ""
    assert not folder.parents[1].exists()


def test_a_worker_of_another_host_is_named_with_the_command_that_removes_it(started, capsys):
    asked, folder, pid = started
    state = json.loads((folder / STATE).read_text())
    (folder / STATE).write_text(json.dumps({**state, "node": "other", "birth": "another"}))
    for request in (asked, ending(asked)):
        said = answer(request, capsys)["failed"]
        assert "other" in said
        assert str(folder) in said
    assert folder.exists()
    assert agent.process_start(pid)


@pytest.mark.parametrize("damage", [None, '{"pid"'])
def test_a_worker_that_runs_without_its_state_is_named_and_keeps_its_folder(started, capsys, damage):
    asked, folder, pid = started
    (folder / STATE).unlink() if damage is None else (folder / STATE).write_text(damage)
    for request in (asked, ending(asked)):
        assert str(pid) in answer(request, capsys)["failed"]
    assert folder.exists()
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    assert len(answer(ending(asked), capsys)["ok"]["ended"]) == 1
    assert not folder.parents[1].exists()


def test_a_full_disk_ends_no_worker_that_is_to_be_replaced(started, capsys, monkeypatch):
    asked, _, pid = started

    def full(path, *_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(agent, "_write_private", full)
    assert "--remote-dir" in answer({**asked, "digest": "2", "files": []}, capsys)["failed"]
    assert agent.process_start(pid)


def test_a_workers_age_is_never_negative(started):
    _, folder, _ = started
    state = json.loads((folder / STATE).read_text())
    (folder / STATE).write_text(json.dumps({**state, "since": 1e12}))
    assert agent.WorkerProcess(folder).describe()["age"] == 0.0


@pytest.mark.parametrize(("report", "fails"), [("", True), ('{"begun": true}\n', False)])
def test_a_program_that_ends_well_has_been_a_worker_only_if_it_began(tmp_path, report, fails):
    (tmp_path / agent.LOG).write_text("usage: worker\n")
    (tmp_path / agent.REPORTS).write_text(report)
    ended = subprocess.Popen(["true"])
    ended.wait()
    with pytest.raises(agent.FailedError, match="usage: worker") if fails else nullcontext():
        agent._wait_for_begin(ended, tmp_path, Channel())
