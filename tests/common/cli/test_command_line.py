"""The command line: finding and loading verbs, help, and errors for typing mistakes."""

import re
import subprocess
import sys
from importlib.metadata import EntryPoint, entry_points

import pytest

from dreamfleet.common.cli import command_line
from dreamfleet.common.errors import DreamfleetError, UsageError
from tests.support.processes import DEADLINE

BROKEN = EntryPoint("broken", "tests.no_such_module", command_line.GROUP)


def points(*more):
    return {point.name: point for point in (*entry_points(group=command_line.GROUP), *more)}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("coordinator", "--populaton", "8"), "unrecognized arguments: --populaton 8; did you mean --population?"),
        (("coordinator", "--evaluate-evry=3"), "did you mean --evaluate-every?"),
        (("coordinator", "--popsize", "8"), "unrecognized arguments: --popsize 8; did you mean --population?"),
        (("worker", "--conect", "tcp/a:1"), "did you mean --connect?"),
        (("train", "vae", "--data", "x", "--updats", "3"), "did you mean --updates?"),
        (("status", "--xyzzy"), "unrecognized arguments: --xyzzy\n"),
    ],
)
def test_the_error_for_an_unknown_flag_suggests_the_nearest(words, said, capsys):
    with pytest.raises(SystemExit) as left:
        command_line.main(words)
    assert left.value.code == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("wokrer",), "unknown verb 'wokrer': did you mean 'worker'?"),
        (("runs", "lits"), "unknown verb 'runs lits': did you mean 'runs list'?"),
        (("xyzzy",), "unknown verb 'xyzzy'; `dreamfleet --help` lists them"),
    ],
)
def test_the_error_for_an_unknown_verb_suggests_the_nearest(words, said, capsys):
    assert command_line.main(words) == UsageError.exit_code
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("words", [(), ("runs",)])
def test_a_missing_verb_is_an_error(words, capsys):
    with pytest.raises(SystemExit) as left:
        command_line.main(words)
    assert left.value.code == 2
    assert "name a verb" in capsys.readouterr().err


@pytest.mark.parametrize("words", [("--help",), ("runs", "--help"), ("worker", "--help"), ("train", "vae", "--help")])
def test_help_lists_the_exit_codes(words, capsys):
    with pytest.raises(SystemExit) as left:
        command_line.main(words)
    assert left.value.code == 0
    assert "130 it was interrupted" in " ".join(capsys.readouterr().out.split())


def test_every_verb_has_the_flags_for_config_and_logs():
    for name, point in points().items():
        text = command_line.build_parser(name, point.load()).format_help()
        assert "--config" in text, name
        assert "--log-level" in text, name


SILENT = {"dashboard", "demo", "router", "worker"}  # these work for a person who watches, or for nobody


def test_every_verb_with_output_has_json():
    verbs = {name: command_line.build_parser(name, point.load()).format_help() for name, point in points().items()}
    assert {name for name, text in verbs.items() if "--json" not in text} <= SILENT


def test_a_broken_verb_does_not_affect_others(capsys, tmp_path):
    assert command_line.run_verb(points(BROKEN), ["runs", "list", "--runs-dir", str(tmp_path)]) == 0
    with pytest.raises(SystemExit):
        command_line.run_verb(points(BROKEN), ["--help"])
    output = " ".join(capsys.readouterr().out.split())
    assert re.search(r"broken BROKEN: the verb 'broken' cannot be loaded from tests\.no_such_module", output)
    assert "score candidates for a run" in output
    with pytest.raises(DreamfleetError, match=r"'broken' cannot be loaded .*ModuleNotFoundError"):
        command_line.run_verb(points(BROKEN), ["broken"])


def test_the_module_and_the_version():
    command = [sys.executable, "-m", "dreamfleet", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=DEADLINE)
    assert re.fullmatch(r"dreamfleet \d+\.\d+\.\d+\S*\n", done.stdout)


def test_the_help_of_fork_shows_its_own_defaults(capsys):
    with pytest.raises(SystemExit):
        command_line.main(["fork", "--help"])
    output = " ".join(capsys.readouterr().out.split())
    assert "candidates a generation (default RUN's own)" in output
    assert "(default 32)" not in output


def test_closed_streams_are_replaced(tmp_path):
    program = (
        "import os, sys; from dreamfleet.common.cli.command_line import main; assert sys.stdout is None; "
        "main(['runs', 'list']); raise SystemExit(os.open('journal', os.O_CREAT | os.O_WRONLY))"
    )
    command = ["bash", "-c", '"$@" <&- >&- 2>&-', "-", sys.executable, "-c", program]
    number = subprocess.run(command, cwd=tmp_path, check=False, timeout=DEADLINE).returncode
    assert number > command_line.LAST_STREAM


def test_a_lack_of_memory_is_one_line(monkeypatch, capsys):
    def fail(*_):
        raise MemoryError("Unable to allocate 81.7 GiB")

    monkeypatch.setattr("dreamfleet.common.cli.command_line.run_verb", fail)
    assert command_line.main(["tasks"]) == 1
    assert capsys.readouterr().err.startswith(
        "dreamfleet: not enough memory on this host (Unable to allocate 81.7 GiB): "
    )
