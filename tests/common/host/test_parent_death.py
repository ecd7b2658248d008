import subprocess
import sys

from tests.support.processes import DEADLINE

PROGRAM = """
import os, signal, sys, time
from multiprocessing import get_context
from dreamfleet.common.host.parent_death import end_on_signals, signals_blocked

def serve():
    end_on_signals()
    time.sleep(100)

if __name__ == "__main__":
    with signals_blocked():
        child = get_context("spawn").Process(target=serve)
        child.start()
    os.kill(child.pid, signal.SIGINT)
    child.join()
    print(child.exitcode)
"""


def test_ctrl_c_ends_a_child_without_a_word_even_amid_its_imports(tmp_path):
    (tmp_path / "program.py").write_text(PROGRAM)
    command = [sys.executable, tmp_path / "program.py"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=DEADLINE)
    assert (done.stdout, done.stderr) == ("-2\n", "")
