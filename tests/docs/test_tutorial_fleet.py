"""The tutorial's commands on three hosts, with its addresses: a worker is lost, then the coordinator, and no result.

Tests coordinator/dispatch/fleet.py, coordinator/dispatch/member.py and coordinator/service/run_log.py.
"""

import os
import re
import secrets
import shlex
import shutil
import subprocess
from contextlib import ExitStack, contextmanager

import pytest

from dreamfleet.common.host.processes import command
from tests.support.processes import DEADLINE, ROOT, environment

PAGE = (ROOT / "docs" / "tutorials" / "fleet.md").read_text()
HOSTS = dict(re.findall(r"`(home|red|blue)` is (10\.77\.0\.\d)", PAGE))
SMALL = "--population", 4, "--evaluate-every", 0


@contextmanager
def three_hosts(folder):
    """The prefix of a command for each host: a namespace with its address, and a folder of its own."""

    def ip(words):
        subprocess.run(["ip", *words.split()], check=True, capture_output=True)

    tag = secrets.token_hex(3)
    inside = {name: f"df{tag}{name}" for name in HOSTS}
    with ExitStack() as stack:
        for name, space in inside.items():
            ip(f"netns add {space}")
            stack.callback(ip, f"netns del {space}")
            ip(f"-n {space} link set lo up")
            (folder / name).mkdir()
        home = inside["home"]
        ip(f"-n {home} link add switch type bridge")
        ip(f"-n {home} addr add {HOSTS['home']}/24 dev switch")
        ip(f"-n {home} link set switch up")
        for name in ("red", "blue"):
            ip(f"-n {home} link add {name} type veth peer name cable netns {inside[name]}")
            ip(f"-n {home} link set {name} master switch up")
            ip(f"-n {inside[name]} addr add {HOSTS[name]}/24 dev cable")
            ip(f"-n {inside[name]} link set cable up")
        yield {
            name: ("ip", "netns", "exec", space, "env", "-C", str(folder / name), f"HOME={folder / name}",
                   f"DREAMFLEET_CACHE={folder / name / 'cache'}")
            for name, space in inside.items()
        }  # fmt: skip


def find_command(beginning):
    """The words of the page's command that begins so, without the program's name."""
    (found,) = {line for line in re.findall(r"^dreamfleet (.+)$", PAGE, re.MULTILINE) if line.startswith(beginning)}
    return shlex.split(found, comments=True)


def on_page(text):
    assert text in PAGE
    return text


@pytest.mark.slow
@pytest.mark.wording
@pytest.mark.needs_programs("ip")
@pytest.mark.timeout(3 * DEADLINE)
@pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root")
def test_its_commands_lead_through_two_losses(tmp_path, processes):
    with three_hosts(tmp_path) as hosts:

        def run(host, beginning, code=0):
            done = subprocess.run(
                [*hosts[host], *command(*find_command(beginning))], env=environment(tmp_path / host / "cache"),
                capture_output=True, text=True, timeout=DEADLINE, check=False,
            )  # fmt: skip
            assert done.returncode == code, done.stderr
            return done.stdout + done.stderr

        def start(host, beginning, *more):
            return processes.start(*find_command(beginning), *more, inside=hosts[host])

        for step in ("access init", "access issue coordinator", "access issue worker", "access issue operator"):
            run("home", step)
        for host, file in (("red", "lab.join"), ("blue", "lab.join"), ("blue", "me.join")):
            shutil.copy(tmp_path / "home" / file, tmp_path / host)

        coordinator = start("home", "coordinator --run night", *SMALL)
        coordinator.wait_for(on_page("listening on tls/0.0.0.0:7447"))
        workers = {host: start(host, f"worker --join lab.join --name {host}") for host in ("red", "blue")}
        for each in workers.values():
            each.wait_for(on_page("joined run night as"))
        coordinator.wait_for_event("generation", number=1)
        status = run("blue", "status --join")
        assert "red.1/" in status
        assert "blue.1/" in status

        workers["blue"].end()
        coordinator.wait_for(on_page("is lost: it was killed, or its connection was cut"))
        workers["blue"] = start("blue", "worker --join lab.join --name blue")
        workers["blue"].wait_for(on_page("joined run night as"))

        coordinator.end()
        for each in workers.values():
            each.wait_for(
                on_page("the coordinator of run night left or cannot be reached; this worker waits for this run only")
            )
        assert on_page("no one answers at tls/10.77.0.1:7447") in run("blue", "status --join", 1)
        again = start("home", "coordinator --resume night")
        again.wait_for_event("begin", incarnation=2)
        for each in workers.values():
            each.wait_for(on_page("joined run night again, incarnation"))
        again.wait_for_event("generation")

        assert on_page("speaks TLS: its fleet needs a join file") in run("blue", "status --connect", 1)
        assert on_page("run night is stopped; continue it on its host with:") in run("blue", "stop night")
        for each in workers.values():
            each.wait_for(on_page("leaving run night (the run dismissed its workers)"))
            assert each.finish()[0] == 0
        assert again.finish()[0] == 130
