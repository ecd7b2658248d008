"""Workers on hosts that a real sshd leads to: brought up, left, followed, ended; and whatever stands in the way.
Tests coordinator/addons/spawn/verb.py."""

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from dreamfleet.common.addons.access.authority import Authority
from dreamfleet.coordinator.addons.spawn.agent import process_start
from tests.support import tasks
from tests.support.disks import small_disk
from tests.support.processes import DEADLINE, free_port, until
from tests.support.programs import find_program
from tests.support.sshd import new_key

TOY = ("--task", tasks.TOY, "--population", 4, "--episodes", 1, "--evaluate-every", 0)


def write_file(processes, hosts, *names, more=""):
    rows = "".join(f'[[host]]\naddress = "{name}"\nslots = 1\n' for name in names)
    path = processes.folder / "hosts.toml"
    path.write_text(
        f'connect = ["{processes.endpoint}"]\n[spawn]\nssh = "{hosts.ssh}"\nremote_python = "{sys.executable}"\n'
        f'worker_flags = "--task {tasks.TOY}"\n{more}\n{rows}'
    )
    return path


def words(hosts, *more):
    return ("--ssh", hosts.ssh, "--remote-python", sys.executable, *more)


def rows_of(processes, *arguments, code=0, patience=DEADLINE):
    """The rows that a verb prints, by host."""
    done, out, err = processes.call(*arguments, "--json", timeout=patience)
    assert done == code, err
    return {row["host"]: row for row in json.loads(out.splitlines()[-1])["hosts"]}


def pid_on(host):
    return json.loads((host.root() / "workers" / host.name / "worker.json").read_text())["pid"]


@pytest.mark.slow
def test_up_brings_hosts_to_a_run_again_leaves_them_and_down_leaves_nothing(processes, hosts):
    a, b = hosts.add("a"), hosts.add("b")
    coordinator = processes.coordinator(*TOY)
    file = write_file(processes, hosts, "a", "b", more="tunnel = false")
    assert {row["state"] for row in rows_of(processes, "spawn", "--hosts", file, "--check").values()} == {"ready"}
    assert not a.root().exists()

    first = rows_of(processes, "spawn", "--hosts", file)
    assert [row["state"] for row in first.values()] == ["started"] * 2
    pids = [pid_on(host) for host in (a, b)]
    coordinator.wait_for_event("generation", number=1)
    until(lambda: processes.status()["slots"] == 2)

    again = rows_of(processes, "spawn", "--hosts", file)
    assert {row["state"] for row in again.values()} == {"running"}
    assert [pid_on(host) for host in (a, b)] == pids
    file.write_text(file.read_text().replace("slots = 1", "slots = 2", 1))
    changed = rows_of(processes, "spawn", "--hosts", file)
    assert {name: row["state"] for name, row in changed.items()} == {"a": "replaced", "b": "running"}

    assert {row["state"] for row in rows_of(processes, "down", "--hosts", file).values()} == {"left"}
    assert not any(process_start(pid) for pid in pids)
    assert [list(host.home.iterdir()) for host in (a, b)] == [[], []]
    assert {row["state"] for row in rows_of(processes, "down", "a", "b", "--ssh", hosts.ssh).values()} == {"nothing"}


@pytest.mark.slow
def test_through_a_tunnel_workers_serve_a_coordinator_on_loopback_and_end_with_the_command(processes, hosts):
    a = hosts.add("a")
    coordinator = processes.coordinator(*TOY)
    spawn = ("spawn", "a", "--connect", processes.endpoint, *words(hosts, "--worker-flags", f"--task {tasks.TOY}"))
    command = processes.start(*spawn)
    command.wait_for_event("tunnels")
    pid = pid_on(a)
    coordinator.wait_for_event("generation", number=1)

    refused = rows_of(processes, *spawn, code=1)["a"]
    assert refused["state"] == "failed"

    code, out = command.stop(signal.SIGINT)
    assert code == 0, "".join(command.lines)
    assert "left" in out
    assert not process_start(pid)
    assert not (a.root() / "workers" / "a").exists()

    command = processes.start(*spawn)
    command.wait_for_event("tunnels")
    pid = pid_on(a)
    command.popen.kill()
    os.killpg(command.popen.pid, signal.SIGKILL)
    until(lambda: not (a.root() / "workers" / "a").exists())
    assert not process_start(pid)


@pytest.mark.slow
def test_a_log_is_followed_until_the_worker_ends_or_somebody_has_seen_enough(processes, hosts):
    a, coordinator = hosts.add("a"), processes.coordinator(*TOY)
    flags = ("--connect", processes.endpoint, "--no-tunnel", "--follow")
    # The worker outlives its coordinator until the second command follows it: another one would wait for ever.
    own = ("--worker-flags", f"--task {tasks.TOY} --exit-when-done --coordinator-timeout 15")
    command = processes.start("spawn", "a", *words(hosts, *flags, *own))
    coordinator.wait_for_event("generation", number=1)
    assert command.stop(signal.SIGINT)[0] == 0, "".join(command.lines)
    assert process_start(pid_on(a))

    command = processes.start("spawn", "a", *words(hosts, *flags, *own))
    coordinator.popen.send_signal(signal.SIGTERM)
    code, out = command.finish()
    assert code == 0
    assert sum(line.startswith("a | ") and "run test" in line for line in out.splitlines()) >= 2, "it joins and leaves"


@pytest.mark.slow
def test_two_commands_at_once_start_one_worker(processes, hosts):
    a = hosts.add("a")
    file = write_file(processes, hosts, "a", more="tunnel = false")
    both = [processes.start("spawn", "--hosts", file, "--json") for _ in range(2)]
    states = [json.loads(each.finish()[1])["hosts"][0]["state"] for each in both]
    assert sorted(states) == ["running", "started"]
    pid = pid_on(a)
    rows_of(processes, "down", "--hosts", file, "--now")
    assert not process_start(pid)


@pytest.fixture
def mute():
    """A port where somebody listens and nobody answers."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server


@pytest.mark.slow
def test_each_thing_that_stands_in_the_way_is_said_and_the_others_come_up(processes, hosts, mute, tmp_path):
    for name in ("good", "changed", "strange", "locked", "bare"):
        hosts.add(name, **({"path": "/nowhere"} if name == "bare" else {}))
    hosts.write(refused=("127.0.0.1", free_port()), lost=("host.invalid", 22), mute=mute.getsockname())
    foreign = new_key(tmp_path / "foreign")
    stranger = hosts.config_with(foreign)
    keys = hosts.known.read_text().splitlines()
    other = foreign.with_suffix(".pub").read_text().split()[:2]
    keys[1] = " ".join([keys[1].split()[0], *other])
    hosts.known.write_text("\n".join([keys[0], keys[1], *keys[3:], ""]))
    rows = ""
    for name in ("good", "changed", "strange", "bare", "refused", "lost"):
        rows += f'[[host]]\naddress = "{name}"\nremote_python = "{"" if name == "bare" else sys.executable}"\n'
    rows += f'[[host]]\naddress = "locked"\nssh = "ssh -F {stranger}"\nremote_python = "{sys.executable}"\n'
    rows += f'[[host]]\naddress = "good"\nname = "wrong"\nremote_python = "{tmp_path}/none"\n'
    rows += f'[[host]]\naddress = "mute"\nssh = "{hosts.ssh} -o ConnectTimeout=2"\n'
    file = tmp_path / "hosts.toml"
    file.write_text(f'[spawn]\ntunnel = false\nssh = "{hosts.ssh}"\nslots = 1\n{rows}')
    found = rows_of(processes, "spawn", "--hosts", file, code=1)
    assert found.pop("good")["state"] == "started"
    assert {row["state"] for row in found.values()} == {"failed"}
    reasons = {"changed": "ssh-keygen -R", "bare": " 3.11", "wrong": " 3.11"}
    assert {name: why for name, why in reasons.items() if why not in found[name]["what"]} == {}
    assert len({row["what"] for row in found.values()}) == len(found) - 1, "two of them lack a Python"
    rows_of(processes, "down", "good", *words(hosts), "--now")


def test_ctrl_c_while_hosts_are_brought_up_ends_the_command_and_not_what_others_hold(processes, hosts, tmp_path):
    hosts.add("a")
    slow, asked = tmp_path / "python", tmp_path / "asked"
    slow.write_text(f'#!/bin/sh\n[ "$1" = -c ] && exit 0\ntouch {asked}\nexec cat > /dev/null\n')
    slow.chmod(0o755)
    command = processes.start("spawn", "a", "--ssh", hosts.ssh, "--remote-python", slow)
    until(asked.exists)
    assert command.stop(signal.SIGINT)[0] == 130


@pytest.mark.slow
def test_a_full_disk_and_a_folder_that_cannot_be_written_are_said(processes, hosts, tmp_path):
    hosts.add("a")
    with small_disk(tmp_path / "disk", 1) as disk:
        if disk is None:
            pytest.skip("mounting a disk needs root")
        flags = ("--no-tunnel", "--slots", 1, "--remote-dir", disk.path / "fleet")
        room = rows_of(processes, "spawn", "a", "--ssh", hosts.ssh, *flags, code=1)["a"]["what"]
        assert "--remote-dir" in room
        disk.fill()
        full = rows_of(processes, "spawn", "a", *words(hosts, *flags), code=1)["a"]["what"]
        assert "--remote-dir" in full
        assert rows_of(processes, "down", "a", *words(hosts, "--remote-dir", disk.path / "fleet"))
        assert not (disk.path / "fleet").exists()
        disk.free()
        subprocess.run(["mount", "-o", "remount,noexec", disk.path], check=True)
        still = rows_of(processes, "spawn", "a", "--ssh", hosts.ssh, *flags, code=1)["a"]["what"]
        assert "noexec" in still
    denied = rows_of(processes, "spawn", "a", *words(hosts, "--no-tunnel", "--remote-dir", "/proc/fleet"), code=1)["a"]
    assert "/proc/fleet" in denied["what"]


def test_a_worker_that_ends_at_once_says_why_and_a_number_in_anothers_hands_is_left_alone(processes, hosts):
    a = hosts.add("a")
    bad = rows_of(processes, "spawn", "a", *words(hosts, "--no-tunnel", "--worker-flags=--nonsense"), code=1)["a"]
    assert "--nonsense" in bad["what"]
    bystander = processes.worker()
    path = a.root() / "workers" / "a" / "worker.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "pid": bystander.popen.pid}))
    rows_of(processes, "down", "a", *words(hosts), "--now")
    assert bystander.popen.poll() is None
    assert list(a.home.iterdir()) == []


@pytest.mark.slow
def test_a_join_file_is_handed_over_by_no_command_line_for_its_reader_alone(processes, hosts, tmp_path):
    a, join = hosts.add("a"), tmp_path / "hosts.join"
    authority = Authority.create(tmp_path / "access")
    authority.issue("worker", "hosts", join, connect=[f"tls/127.0.0.1:{processes.port}"])
    watched = tmp_path / "python"
    watched.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/words\nexec {sys.executable} "$@"\n')
    watched.chmod(0o755)
    rows_of(processes, "spawn", "a", "--ssh", hosts.ssh, "--remote-python", watched, "--join", join)
    there = a.root() / "workers" / "a" / "join"
    assert there.read_bytes() == join.read_bytes()
    assert there.stat().st_mode & 0o777 == 0o600
    assert "PRIVATE" not in (tmp_path / "words").read_text()
    rows_of(processes, "down", "a", *words(hosts))
    assert list(a.home.iterdir()) == []


BASH = 'BASH_ENV=$HOME/.bashrc exec bash -c "$SSH_ORIGINAL_COMMAND"'  # as bash reads it under sshd
FISH, TCSH = (f'exec {shell} -c "$SSH_ORIGINAL_COMMAND"' for shell in ("fish", "tcsh"))  # as sshd calls a login shell
SHELLS = {
    "fish": (FISH, ".config/fish/config.fish", "echo 'dreamfleet-host, but not ours: welcome to $fish'"),
    "tcsh": (TCSH, ".cshrc", "echo 'Welcome!'"),
    "banner": (BASH, ".bashrc", "echo Welcome; echo 'Do not disturb' >&2; printf 'no line end'"),
    "hanging": (BASH, ".bashrc", "sleep 1000"),
    "endless": (BASH, ".bashrc", "while :; do echo Welcome; done"),
    "waiting": (BASH, ".bashrc", "read -r answer; exit 0"),
}


@pytest.mark.long
@pytest.mark.needs_programs("sshd", "ssh", "fish", "tcsh")
def test_any_login_shell_serves_and_a_broken_one_is_one_row(processes, hosts):
    for name, (command, file, text) in SHELLS.items():
        programs = f"{Path(find_program('fish')).parent}:/usr/bin:/bin"
        path = hosts.add(name, ForceCommand=command, path=programs).home / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n")
    spawn = ("spawn", *SHELLS, "--connect", processes.endpoint, "--no-tunnel", "--slots", 1, *words(hosts))
    rows = rows_of(processes, *spawn, code=1, patience=3 * DEADLINE)
    assert [rows[name]["state"] for name in ("fish", "tcsh", "banner")] == ["started"] * 3
    assert " 60 " in rows["hanging"]["what"]
    assert " 1 " in rows["endless"]["what"]
    assert rows["waiting"]["state"] == "failed"
    down = rows_of(processes, "down", "fish", "tcsh", "banner", "--now", "--ssh", hosts.ssh)
    assert {row["state"] for row in down.values()} == {"left"}
