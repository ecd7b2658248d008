"""Ends an agent at each of its steps in turn, and has another one remove what is left: `python FILE FOLDER MODE`.

A step changes a file, as an audit hook sees it. `killed` ends the process there, `full` has the step fail as on a full
disk. Writes a line of JSON for each step: the agent's answer to `end`, what is left, and whether a worker lives.
It is a process of its own, as audit hooks stay.
"""

import errno
import io
import itertools
import json
import os
import sys
import time
from contextlib import redirect_stdout
from pathlib import Path

from dreamfleet.coordinator.addons.spawn import agent

WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT
WORKER = (
    "import os, sys, time; open(sys.argv[1], 'w').write(str(os.getpid())); print('x', flush=True); "
    "open(os.environ['DREAMFLEET_REPORTS'], 'w').write('{\"begun\": true}\\n'); time.sleep(600)"
)


def counts(event, arguments, root):
    """Whether an event changes something in the agent's folder."""
    if event == "open":
        return root in str(arguments[0]) and (arguments[2] or 0) & WRITES
    return event in ("os.mkdir", "os.rename", "os.remove", "os.chmod", "os.rmdir") and root in str(arguments[0])


def interrupt_at(step, mode, root):
    steps, done = itertools.count(1), False

    def hook(event, arguments):
        nonlocal done
        if not done and counts(event, arguments, root) and next(steps) == step:
            done = True
            if mode == "killed":
                os._exit(9)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), root)

    sys.addaudithook(hook)
    return lambda: done


def in_child(action, *arguments):
    """The exit code of a function in a child process, and what the agent said there."""
    reading, writing = os.pipe()
    if not (pid := os.fork()):
        with redirect_stdout(io.StringIO()) as said:
            code = action(*arguments)
        os.write(writing, said.getvalue().encode())
        os._exit(code)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        text = pipe.read()
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), text


def bring_up(root, pid_file, step, mode):
    """Install and start; 0 once no step was interrupted."""
    was_interrupted = interrupt_at(step, mode, root)
    channel = agent.Channel()
    agent._call = lambda folder, *_, **__: (folder.environment("e") / "bin").mkdir(parents=True, exist_ok=True)
    common = {"root": root}
    agent.handle_request({"do": "install", "environment": "e", "wheel": "w", "offline": True, **common}, channel)
    agent.handle_request(
        {"do": "start", "name": "box", "python": sys.executable, "words": ["-c", WORKER, pid_file], "env": {},
         "slots": 1, "held": False, "digest": "1", **common}, channel,
    )  # fmt: skip
    return 8 if was_interrupted() else 0


def take_down(root):
    agent.handle_request({"do": "end", "root": root, "names": None, "now": True, "keep": False}, agent.Channel())
    return 0


def main():
    folder, mode = Path(sys.argv[1]), sys.argv[2]
    os.dup2(os.pipe()[0], 0)  # an ssh connection that stays open
    for step in itertools.count(1):
        home, pid_file = folder / str(step), folder / f"{step}.pid"
        root = str(home / "share" / "fleet")
        home.mkdir()
        code, _ = in_child(bring_up, root, str(pid_file), step, mode)
        if code == 9:
            time.sleep(0.05)  # a worker that nobody knows of would begin now
        _, said = in_child(take_down, root)
        left = sorted(str(each.relative_to(home)) for each in home.rglob("*"))
        lives = pid_file.exists() and bool(agent.process_start(int(pid_file.read_text() or 0)))
        found = {"code": code, "ok": '"ok"' in said, "left": left, "lives": lives, "said": said}
        sys.stdout.write(json.dumps(found) + "\n")
        if code not in (8, 9):
            return


main()
