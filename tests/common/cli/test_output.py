import fcntl
import json
import logging
import os
import pty
import shlex
import struct
import subprocess
import sys
import termios
from argparse import Namespace

from dreamfleet.common.cli.output import print_answer, print_next, print_rows
from tests.support.processes import DEADLINE, started

LONG = "a-run-whose-name-is-longer-than-any-column-of-a-narrow-terminal-would-be"
ROWS = [
    {"run": LONG, "state": "said [bold]so[/] and [worker]", "generations": 12},
    {"run": "night\x1b[2J", "state": "ended: \x1b]0;owned\x07\u202e", "generations": 3},
]
SHOW = f"from dreamfleet.common.cli.output import print_rows; print_rows({ROWS!r}, right=['generations'])"


def in_terminal(code, columns):
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    seen = {**os.environ, "TERM": "xterm"}
    seen.pop("COLUMNS", None)
    with started([sys.executable, "-c", code], stdout=theirs, stdin=theirs, env=seen) as child:
        os.close(theirs)
        output = b""
        try:
            while part := os.read(ours, 4096):
                output += part
        except OSError:  # the other end is closed
            pass
        assert child.wait(DEADLINE) == 0
    os.close(ours)
    return output.decode()


def test_a_narrow_terminal_truncates_nothing_keeps_brackets_and_is_not_controlled_by_untrusted_text():
    piped = subprocess.run([sys.executable, "-c", SHOW], check=True, capture_output=True, text=True).stdout
    for output in (in_terminal(SHOW, 40), piped):
        for text in (LONG, "said [bold]so[/] and [worker]", "night\\x1b[2J", "owned\\x07\\u202e"):
            assert text in output
        assert "…" not in output


def test_a_pipe_gets_an_aligned_table_whatever_its_width(capsys):
    print_rows([{"a": "x y", "n": 1, "z": LONG * 9}, {"a": "line\nbreak\t日本", "n": None, "z": ""}], right=["n"])
    assert capsys.readouterr().out.splitlines() == [
        "a                n  z",
        f"x y              1  {LONG * 9}",
        "line break 日本  -",
    ]


def test_output_is_text_or_json(capsys, tmp_path):
    print_answer(Namespace(json=False), "archived", archived=tmp_path)
    print_answer(Namespace(json=True), "archived", archived=tmp_path)
    first, second = capsys.readouterr().out.splitlines()
    assert first == "archived"
    assert json.loads(second) == {"archived": str(tmp_path)}


def test_the_next_command_is_said_where_a_person_reads(capsys, caplog):
    words = ("inspect", "a b.zip")
    print_next(Namespace(json=False), words, ("runs", "list"))
    first, second = capsys.readouterr().err.splitlines()
    assert shlex.split(first)[-2:] == ["inspect", "a b.zip"]
    assert shlex.split(second)[-2:] == ["runs", "list"]
    print_next(Namespace(json=True), words)
    with caplog.at_level(logging.WARNING, "dreamfleet"):
        print_next(Namespace(), words)
    assert capsys.readouterr() == ("", "")
