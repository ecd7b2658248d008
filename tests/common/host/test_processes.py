"""Verbs as child processes. Tests parent_death.py."""

import os
import subprocess
import sys

from dreamfleet.common.host.processes import VerbProcess
from dreamfleet.common.host.reports import ADDRESS
from tests.support import tasks
from tests.support.processes import DEADLINE, ends

CHATTER = ("sh", "-c", 'yes out | head -c 300000; yes err | head -c 300000 >&2; exec "$@"', "sh")


def test_a_child_with_much_output_does_not_block_and_imports_no_modules_of_the_current_folder(tmp_path, monkeypatch):
    for name in ("dreamfleet.py", "argparse.py", "zenoh.py"):
        (tmp_path / name).write_text("raise SystemExit('hostile')\n")
    monkeypatch.chdir(tmp_path)
    with VerbProcess("--version", inside=CHATTER) as child:
        code, out = child.finish(DEADLINE)
    assert code == 0
    assert "dreamfleet 0." in out
    assert "err\n" in child.lines


def test_a_child_gets_sigterm_before_sigkill(processes, random_bundle):
    words = ("coordinator", "--run", "asked", "--runs-dir", processes.runs, "--listen", processes.endpoint)
    with VerbProcess(*words, "--bundle", random_bundle.path, "--task", tasks.TOY) as child:
        child.wait_for_report(ADDRESS, DEADLINE)
    assert child.popen.returncode == 130
    assert " asked " in child.lines[-1]


def test_a_child_dies_with_a_killed_parent():
    program = (
        "import sys; from dreamfleet.common.host.processes import VerbProcess\n"
        "child = VerbProcess('worker', '--connect', 'tcp/127.0.0.1:1', ends_with_parent=True)\n"
        "print(child.pid, flush=True); sys.stdin.read()"
    )
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", program], stdin=pipe, stdout=pipe, text=True) as parent:
        child = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
    assert ends(child)
