import os
import select
import subprocess
import sys

from tests.support.processes import DEADLINE


def test_a_child_dies_with_a_killed_parent(tmp_path):
    program = (
        "import sys; from dreamfleet.common.host.processes import VerbProcess\n"
        "child = VerbProcess('worker', '--connect', 'tcp/127.0.0.1:1', ends_with_parent=True)\n"
        "print(child.pid, flush=True); sys.stdin.read()"
    )
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", program], stdin=pipe, stdout=pipe, text=True) as parent:
        child = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
    try:
        assert select.select([child], [], [], DEADLINE)[0], "it lives on"
    finally:
        os.close(child)
