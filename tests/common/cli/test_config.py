"""Tests global_config.py."""

import re
from argparse import ArgumentParser, Namespace
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest
from msgspec import Meta

from dreamfleet.common.cli.bounds import check_bounds
from dreamfleet.common.cli.config import add_flags, load, option, read_toml
from dreamfleet.common.cli.global_config import add_common_flags, add_global_flags, complete_arguments, resolve_network
from dreamfleet.common.errors import UsageError


@dataclass(frozen=True)
class ThingConfig:
    count: int = option(3, "how many")
    rate: float = option(0.5, "how fast")
    colour: Literal["red", "blue"] = option("red", "which")
    names: tuple[str, ...] = option((), "whose")
    loud: bool = option(False, "or not")
    limit: float | None = option(None, "at most")
    preset: str | None = option(None, "what to begin with")


def flags(*arguments):
    parser = ArgumentParser()
    add_flags(parser, ThingConfig)
    return parser.parse_args(arguments)


def test_precedence_of_sources():
    sources = {
        "base": {"count": 4, "rate": 4.0, "colour": "blue", "names": ("p",)},
        "file": {"thing": {"count": 5, "rate": 5, "names": ["f"]}},
        "environment": {"DREAMFLEET_THING_COUNT": "6", "DREAMFLEET_THING_RATE": "6", "HOME": "/"},
        "flags": flags("--count", "7"),
    }
    assert load(ThingConfig, "thing", **sources) == ThingConfig(7, 6.0, "blue", ("f",))


def test_flags_of_every_type():
    given = flags("--rate", "2", "--colour", "blue", "--names", "a", "b", "--loud", "--limit", "9")
    assert load(ThingConfig, "thing", flags=given) == ThingConfig(3, 2.0, "blue", ("a", "b"), True, 9.0)


@pytest.mark.parametrize(
    ("source", "named"),
    [
        ({"file": {"thing": {"cuont": 1}}}, r"'cuont' .*\[thing\].* 'count'"),
        *(({"file": {"thing": {"count": wrong}}}, f"count .*{wrong!r}") for wrong in ("many", True)),
        ({"file": {"thing": {"colour": "green"}}}, "colour .*red, blue"),
        ({"file": {"thing": {"names": [1]}}}, "names "),
        ({"environment": {"DREAMFLEET_THING_CUONT": "1"}}, "DREAMFLEET_THING_CUONT"),
        *(
            ({"environment": {f"DREAMFLEET_THING_{name}": "x"}}, f"DREAMFLEET_THING_{name} .*'x'")
            for name in ("COUNT", "LOUD")
        ),
    ],
)
def test_unknown_keys_are_refused(source, named):
    with pytest.raises(UsageError, match=named):
        load(ThingConfig, "thing", **source)


def test_a_missing_or_invalid_file_is_refused(tmp_path):
    for number, text in enumerate(("[thign]\n", "thing = 3\n", "[thing\n")):
        (tmp_path / f"{number}.toml").write_text(text)
    for path in (*tmp_path.iterdir(), tmp_path / "missing.toml", tmp_path, Path("/dev/zero")):
        with pytest.raises(UsageError, match=re.escape(str(path))):
            read_toml(path, ["thing"])


def test_a_preset_in_the_file_overrides_only_its_base(tmp_path):
    sizes = {"large": {"count": 90, "rate": 9.0}}
    sources = {"file": {"thing": {"preset": "large", "rate": 5}}, "base": {"count": 2, "colour": "blue"}}
    loaded = load(ThingConfig, "thing", preset=sizes.__getitem__, **sources)
    assert loaded == ThingConfig(90, 5.0, "blue", preset="large")
    with pytest.raises(KeyError):
        load(ThingConfig, "thing", preset=sizes.__getitem__, environment={"DREAMFLEET_THING_PRESET": "tiny"})


def test_flags_are_those_that_were_given_and_may_be_of_some_fields():
    assert vars(flags()) == {}
    assert load(ThingConfig, "thing", flags=Namespace(other=1)) == ThingConfig()
    parser = ArgumentParser()
    add_flags(parser, ThingConfig, only=["count"], texts={"count": "so many"})
    assert "so many" in parser.format_help()
    assert "--rate" not in parser.format_help()


def test_the_unnamed_section_is_the_top_of_the_file(tmp_path):
    path = tmp_path / "fleet.toml"
    path.write_bytes(b"\xef\xbb\xbfcount = 5\r\n[other]\r\nkey = 1\r\n")  # a byte order mark, another system's ends
    file = read_toml(path, ["other"], top=["count"])
    environment = {"DREAMFLEET_RATE": "2", "DREAMFLEET_OTHER_KEY": "3"}
    assert load(ThingConfig, "", file=file, environment=environment) == ThingConfig(5, 2.0)


def test_an_empty_variable_of_a_number_or_a_choice_is_as_none():
    empty = {f"DREAMFLEET_THING_{name}": "" for name in ("COUNT", "RATE", "COLOUR", "LOUD", "LIMIT", "NAMES")}
    file = {"thing": {"count": 5, "colour": "blue", "names": ["f"]}}
    assert load(ThingConfig, "thing", file=file, environment=empty) == ThingConfig(5, colour="blue", names=())


@dataclass(frozen=True)
class Bounded:
    share: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    note: Annotated[str, Meta(max_length=3)] = ""


@pytest.mark.parametrize("given", [{"share": 1.5}, {"share": float("nan")}, {"note": "long"}])
def test_a_number_and_a_texts_length_have_the_bounds_of_their_annotation(given):
    check_bounds(Bounded(0.5, "few"))
    with pytest.raises(UsageError, match=f"--{next(iter(given))}"):
        check_bounds(Bounded(**given))


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
