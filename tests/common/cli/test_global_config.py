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
join = "lab.join"
[worker]
slots = 3
"""


@pytest.fixture
def file(tmp_path):
    (tmp_path / "fleet.toml").write_text(FILE)
    return str(tmp_path / "fleet.toml")


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


def test_precedence_of_file_environment_and_flags(file):
    environment = {"DREAMFLEET_CONNECT": "tcp/environment:1,tcp/other:2", "DREAMFLEET_RUNS_DIR": "/from/environment"}
    args = settled("--config", file, "--runs-dir", "/from/flag", environment=environment)
    assert args.global_config.connect == ("tcp/environment:1", "tcp/other:2")
    assert args.listen == ("tcp/0.0.0.0:1",)
    assert str(args.runs_dir) == "/from/flag"
    assert args.log_level == "error"
    assert {"runs_dir"} <= args.given
    assert args.sources["file"]["worker"] == {"slots": 3}
    assert [settled(*words).log_level for words in (["-q"], ["--log-level", "debug"])] == ["warning", "debug"]


def test_the_environment_can_name_the_file_and_an_empty_variable_unsets_what_it_says(file):
    found = settled(environment={"DREAMFLEET_CONFIG": file}).global_config
    assert (found.connect, found.join) == (("tcp/file:1",), Path("lab.join"))
    assert settled("--config", file, environment={"DREAMFLEET_JOIN": ""}).global_config.join is None


@pytest.mark.parametrize(
    ("source", "named"),
    [
        ({"DREAMFLEET_CONECT": "tcp/a:1"}, "DREAMFLEET_CONECT.*CONNECT"),
        ({"DREAMFLEET_RUN_DIR": "x", "DREAMFLEET_RUNSDIR": "x"}, "RUNS_DIR"),
        ({"DREAMFLEET_CONNECT": "nowhere"}, "nowhere"),
        ({"DREAMFLEET_LOG_LEVEL": "loud"}, "debug, info, warning, error"),
        ({"DREAMFLEET_CONFIG": "absent.toml"}, r"absent\.toml"),
        ('conect = ["tcp/a:1"]\n', "'conect'.* 'connect'"),
        ("connect = 3\n", "connect .*3"),
        ("[wokrer]\n", r"\[wokrer\].* 'worker'"),
        ("[connect]\n", "connect "),
    ],
)
def test_an_invalid_environment_or_file_is_refused_and_others_variables_are_ignored(source, named, tmp_path):
    (tmp_path / "odd.toml").write_text(source if isinstance(source, str) else "")
    environment = {"DREAMFLEET_CONFIG": str(tmp_path / "odd.toml")} if isinstance(source, str) else source
    with pytest.raises(UsageError, match=named):
        settled(environment=environment)
    others = {"DREAMFLEET_CACHE": "x", "DREAMFLEET_TEST_STEPS": "y", "DREAMFLEET_WORKER_SLOTS": "1"}
    assert settled(environment=others).global_config == settled().global_config
