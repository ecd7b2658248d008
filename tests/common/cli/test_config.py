import re
from argparse import ArgumentParser, Namespace
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from dreamfleet.common.cli.config import add_flags, load, option, read_toml
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


def test_defaults():
    assert load(ThingConfig, "thing") == ThingConfig()


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
        ({"file": {"thing": {"count": "many"}}}, "count .*'many'"),
        ({"file": {"thing": {"count": True}}}, "count .*True"),
        ({"file": {"thing": {"colour": "green"}}}, "colour .*red, blue"),
        ({"file": {"thing": {"names": [1]}}}, "names "),
        ({"environment": {"DREAMFLEET_THING_CUONT": "1"}}, "DREAMFLEET_THING_CUONT"),
        ({"environment": {"DREAMFLEET_THING_COUNT": "x"}}, "DREAMFLEET_THING_COUNT .*'x'"),
        ({"environment": {"DREAMFLEET_THING_LOUD": "yes"}}, "DREAMFLEET_THING_LOUD .*'yes'"),
    ],
)
def test_unknown_keys_are_refused(source, named):
    with pytest.raises(UsageError, match=named):
        load(ThingConfig, "thing", **source)


def test_a_flag_that_is_not_given_sets_nothing():
    assert vars(flags()) == {}
    assert load(ThingConfig, "thing", flags=Namespace(other=1)) == ThingConfig()


@pytest.mark.parametrize("text", [None, "[thign]\n", "thing = 3\n", "[thing\n"])
def test_a_missing_or_invalid_file_is_refused(tmp_path, text):
    path = tmp_path / "run.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UsageError, match=re.escape(str(path))):
        read_toml(path, ["thing"])


def test_a_preset_in_the_file_overrides_only_its_base(tmp_path):
    sizes = {"large": {"count": 90, "rate": 9.0}}
    sources = {"file": {"thing": {"preset": "large", "rate": 5}}, "base": {"count": 2, "colour": "blue"}}
    loaded = load(ThingConfig, "thing", preset=sizes.__getitem__, **sources)
    assert loaded == ThingConfig(90, 5.0, "blue", preset="large")
    with pytest.raises(KeyError):
        load(ThingConfig, "thing", preset=sizes.__getitem__, environment={"DREAMFLEET_THING_PRESET": "tiny"})


def test_the_unnamed_section_is_the_top_of_the_file(tmp_path):
    path = tmp_path / "fleet.toml"
    path.write_text("count = 5\n[other]\nkey = 1\n")
    file = read_toml(path, ["other"], top=["count"])
    environment = {"DREAMFLEET_RATE": "2", "DREAMFLEET_OTHER_KEY": "3"}
    assert load(ThingConfig, "", file=file, environment=environment) == ThingConfig(5, 2.0)


def test_flags_for_some_fields_of_a_section():
    parser = ArgumentParser()
    add_flags(parser, ThingConfig, only=["count"], texts={"count": "so many"})
    assert "so many" in parser.format_help()
    assert "--rate" not in parser.format_help()


def test_an_empty_variable_of_a_number_or_a_choice_is_as_none():
    empty = {f"DREAMFLEET_THING_{name}": "" for name in ("COUNT", "RATE", "COLOUR", "LOUD", "LIMIT", "NAMES")}
    file = {"thing": {"count": 5, "colour": "blue", "names": ["f"]}}
    assert load(ThingConfig, "thing", file=file, environment=empty) == ThingConfig(5, colour="blue", names=())


def test_a_byte_order_mark_and_another_systems_line_ends_are_read(tmp_path):
    (tmp_path / "marked.toml").write_bytes(b"\xef\xbb\xbf[thing]\r\ncount = 1\r\n")
    assert read_toml(tmp_path / "marked.toml", ["thing"]) == {"thing": {"count": 1}}


def test_a_folder_or_a_device_is_no_configuration_file(tmp_path):
    for path in (tmp_path, Path("/dev/zero")):
        with pytest.raises(UsageError, match=re.escape(str(path))):
            read_toml(path, [])
