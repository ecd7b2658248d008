"""The first commands of docs/how-to/security.md work as written."""

import shlex
import sys

import pytest

from dreamfleet.common.host.reports import ADDRESS
from tests.support.processes import DEADLINE, ROOT, free_port

HOST = "127.0.0.2"  # in no certificate by default


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="other systems have one loopback address")
def test_five_commands_make_a_fleet(processes, tmp_path, monkeypatch):
    port = free_port()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DREAMFLEET_LISTEN", f"tls/{HOST}:{port}")  # others may use 7447
    block = (ROOT / "docs" / "how-to" / "security.md").read_text().split("## In five commands")[1].split("```")[1]
    here = block.replace("coordinator.example", HOST).replace("7447", str(port))
    install, *commands = (shlex.split(line, comments=True) for line in here.splitlines()[1:])
    assert install[:2] == ["pip", "install"]
    words = [command[1:] for command in commands]
    assert [command[0] for command in words] == ["access", "access", "access", "coordinator", "worker"]
    for each in words[:3]:
        code, _, err = processes.call(*each)
        assert code == 0, err
    processes.start(*words[3]).wait_for_report(ADDRESS, DEADLINE)
    processes.start(*words[4], "--slots", 1).wait_for("1 slot")
