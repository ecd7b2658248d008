"""Settings of all verbs: from the top of a file, the environment and flags."""

from argparse import ArgumentParser
from pathlib import Path

import pytest

from dreamfleet.common.cli.global_config import add_common_flags, add_global_flags, complete_arguments, resolve_network
from dreamfleet.common.errors import UsageError

FILE = """
connect = ["tcp/file:1"]
listen = ["tcp/0.0.0.0:1"]
runs_dir = "/from/file"
log_level = "error"

[run]
preset = "dream"

[worker]
slots = 3
"""


def settled(*words, environment=None):
    parser = ArgumentParser()
    add_global_flags(parser, "connect", "runs_dir")
    add_common_flags(parser)
    args = parser.parse_args(words)
    complete_arguments(args, environment or {})
    return args


def test_defaults():
    args = settled()
    assert (resolve_network(args).connect, args.listen, str(args.runs_dir)) == (("tcp/127.0.0.1:7447",), (), "runs")
    assert args.given == {"config"}


def test_precedence_of_file_environment_and_flags(tmp_path):
    path = tmp_path / "fleet.toml"
    path.write_text(FILE)
    environment = {"DREAMFLEET_CONNECT": "tcp/environment:1,tcp/other:2", "DREAMFLEET_RUNS_DIR": "/from/environment"}
    flags = ("--config", path, "--runs-dir", "/from/flag")
    args = settled(*map(str, flags), environment=environment)
    assert args.global_config.connect == ("tcp/environment:1", "tcp/other:2")
    assert args.listen == ("tcp/0.0.0.0:1",)
    assert str(args.runs_dir) == "/from/flag"
    assert args.log_level == "error"
    assert {"runs_dir"} <= args.given
    assert args.sources["file"]["worker"] == {"slots": 3}


def test_an_empty_variable_unsets_the_files_join_file(tmp_path):
    path = tmp_path / "fleet.toml"
    path.write_text('join = "lab.join"\n')
    assert settled("--config", str(path)).global_config.join == Path("lab.join")
    assert settled("--config", str(path), environment={"DREAMFLEET_JOIN": ""}).global_config.join is None


def test_the_environment_can_name_the_file(tmp_path):
    path = tmp_path / "fleet.toml"
    path.write_text(FILE)
    assert settled(environment={"DREAMFLEET_CONFIG": str(path)}).global_config.connect == ("tcp/file:1",)


def test_quiet_logs_only_warnings():
    assert settled("-q").log_level == "warning"
    assert settled("--log-level", "debug").log_level == "debug"


@pytest.mark.parametrize(
    ("environment", "named"),
    [
        ({"DREAMFLEET_CONECT": "tcp/a:1"}, "DREAMFLEET_CONECT.*CONNECT"),
        ({"DREAMFLEET_RUN_DIR": "x", "DREAMFLEET_RUNSDIR": "x"}, "RUNS_DIR"),
        ({"DREAMFLEET_CONNECT": "nowhere"}, "nowhere"),
        ({"DREAMFLEET_LOG_LEVEL": "loud"}, "debug, info, warning, error"),
        ({"DREAMFLEET_CONFIG": "absent.toml"}, r"absent\.toml"),
    ],
)
def test_an_invalid_environment_is_refused(environment, named):
    with pytest.raises(UsageError, match=named):
        settled(environment=environment)


def test_other_programs_variables_are_ignored():
    others = {"DREAMFLEET_CACHE": "x", "DREAMFLEET_TEST_STEPS": "y", "DREAMFLEET_WORKER_SLOTS": "1"}
    assert settled(environment=others).global_config == settled().global_config


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('conect = ["tcp/a:1"]\n', "'conect'.* 'connect'"),
        ("connect = 3\n", "connect .*3"),
        ("[wokrer]\n", r"\[wokrer\].* 'worker'"),
        ("[connect]\n", "connect "),
    ],
)
def test_an_invalid_file_is_refused(tmp_path, text, named):
    path = tmp_path / "fleet.toml"
    path.write_text(text)
    with pytest.raises(UsageError, match=named):
        settled("--config", str(path))
