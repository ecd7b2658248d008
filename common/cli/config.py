"""Configuration: frozen dataclasses filled from defaults, a preset, a TOML file, the environment and flags.

Later sources in this list override earlier ones. A section is one dataclass: `[run]` in TOML, `DREAMFLEET_RUN_...` in
the environment, its field names as flags. The unnamed section is the top of the file and `DREAMFLEET_...`. An unknown
key is an error that suggests the nearest one. A section's field `preset` names the preset. Pages: decisions-notes.md.
"""

import argparse
import tomllib
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, Field, field, fields
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.regular_files import read_text
from dreamfleet.common.printable import suggest

T = TypeVar("T")
Table = Mapping[str, Any]
MAX_BYTES = 1_000_000  # of a configuration file
# What `--help` calls the value of a setting; others are N, a number, or TEXT.
METAVARS = {
    **dict.fromkeys(("connect", "listen"), "ENDPOINT"),
    **dict.fromkeys(("access_dir", "runs_dir", "wheelhouse"), "FOLDER"),
    **dict.fromkeys(("join", "schedule"), "FILE"),
    **dict.fromkeys(("dream_minutes", "minutes"), "MINUTES"),
    **dict.fromkeys(("horizon", "patience", "steps"), "STEPS"),
    **dict.fromkeys(("optimiser_options", "variant"), "NAME=VALUE"),
    "bundle": "BUNDLE", "env": "NAME=VALUE", "environment": "KEY=VALUE", "init": "CONTROLLER", "name": "NAME",
    "observation": "KEY", "preset": "PRESET", "run": "RUN", "subspace": "SUBSPACE", "target": "SCORE", "task": "TASK",
    "trust": "MODULE", "world": "WORLD",
}  # fmt: skip
KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a text", Path: "a path"}


def option(default: Any, text: str, *, flag: bool = True) -> Any:
    """A dataclass field with its default and the text that `--help` shows; without `flag` only a key and a variable."""
    return field(default=default, metadata={"help": text, "flag": flag})


def add_flags(
    parser: argparse.ArgumentParser,
    *sections: type[Any],
    only: Iterable[str] | None = None,
    texts: Mapping[str, str] | None = None,
) -> None:
    """Add a flag for each field of the sections that has a help text, or for those named in `only`.

    A flag that is not given sets nothing. `texts` replaces help texts by field name.
    """
    wanted = None if only is None else frozenset(only)
    for section in sections:
        group = _group(parser, section.__name__.removesuffix("Config").lower())
        hints = get_type_hints(section)
        for each in configurable_fields(section):
            if each.metadata.get("flag", True) if wanted is None else each.name in wanted:
                text = (texts or {}).get(each.name) or each.metadata["help"] + _default_text(each)
                group.add_argument(_flag(each), **_flag_options(each, hints[each.name], text))


def _group(parser: argparse.ArgumentParser, title: str) -> argparse._ArgumentGroup:
    """The argument group of this title; created unless an earlier call did."""
    existing = next((each for each in parser._action_groups if each.title == title), None)
    return existing or parser.add_argument_group(title)


def load(
    section: type[T],
    name: str,
    *,
    flags: argparse.Namespace | None = None,
    environment: Mapping[str, str] | None = None,
    file: Table | None = None,
    base: Table | None = None,
    preset: Callable[[str], Table] | None = None,
) -> T:
    """Load the section `name`; `UsageError` for an unknown key or an invalid value.

    Precedence, highest first: flags, environment, file, `preset` (called with the value of the key `preset`), `base`,
    the dataclass's defaults.
    """
    known = _field_types(section)
    chosen = configured_values(section, name, file, environment)
    chosen.update({key: value for key, value in vars(flags or argparse.Namespace()).items() if key in known})
    named = chosen.get("preset")
    return section(**{**(base or {}), **(preset(named) if preset and named is not None else {}), **chosen})


def configured_values(
    section: type[Any], name: str, file: Table | None, environment: Mapping[str, str] | None
) -> dict[str, Any]:
    """The checked values of the section `name` in the file and the environment."""
    known = _field_types(section)
    table = (file or {}).get(name, {}) if name else {key: (file or {})[key] for key in known if key in (file or {})}
    return {
        **read_table(section, f"[{name}]" if name else "", table),
        **_from_environment(known, name, environment or {}),
    }


def read_settings(
    sections: Sequence[type[Any]], name: str, sources: Mapping[str, Any], texts: Sequence[str]
) -> dict[str, Any]:
    """The values by key that sections of one table `name` are given in the file, the environment, and `texts`.

    Later ones in this order count. `texts` are KEY=VALUE; `sources` are as `complete_arguments` leaves them.
    """
    known = {key: hint for section in sections for key, hint in _field_types(section).items()}
    values = _from_table(known, f"[{name}]", (sources.get("file") or {}).get(name, {}))
    values.update(_from_environment(known, name, sources.get("environment") or {}))
    for text in texts:
        key, equals, value = text.partition("=")
        if not (equals and key):
            raise UsageError(f"--set {text!r}: write KEY=VALUE")
        if key not in known:
            raise UsageError(f"--set {text!r}: unknown key {key!r}{suggest(key, known)}")
        values[key] = _parse_text(known[key], value, f"--set {key}")
    return values


def read_table(section: type[Any], where: str, table: Table) -> dict[str, Any]:
    """The values of a TOML table, converted to its fields' types; `UsageError` names `where` a value is wrong."""
    return _from_table(_field_types(section), where, table)


def read_toml(
    path: Path | None, tables: Iterable[str], top: Iterable[str] = (), arrays: Iterable[str] = (), *,
    kind: str = "configuration file",
) -> dict[str, Any]:  # fmt: skip
    """Read a configuration file with these tables, arrays of tables and top-level keys; `UsageError` for others."""
    if path is None:
        return {}
    try:
        table = tomllib.loads(read_text(path, MAX_BYTES).removeprefix("\ufeff"))  # an editor may mark UTF-8
    except FileNotFoundError:
        raise UsageError(f"no {kind} at {path}") from None
    except OSError as error:
        raise UsageError(f"{path} cannot be read as TOML: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # a number of 5,000 digits is a plain ValueError
        raise UsageError(f"{path} cannot be read as TOML: {error}") from error
    known, keys, repeated = sorted(tables), sorted(top), sorted(arrays)
    for name, value in table.items():
        if name in keys:
            continue
        if name not in (*known, *repeated):
            what = f"table [{name}]" if isinstance(value, dict) else f"key {name!r}"
            raise UsageError(f"{path}: unknown {what}{suggest(name, [*known, *repeated, *keys])}")
        if name in repeated:
            if not (isinstance(value, list) and all(isinstance(each, dict) for each in value)):
                raise UsageError(f"{path}: {name} must be tables, each written [[{name}]]")
        elif not isinstance(value, dict):
            raise UsageError(f"{path}: {name} must be a table, written [{name}]")
    return table


def _from_table(known: Mapping[str, Any], where: str, table: Table) -> dict[str, Any]:
    values = {}
    for key, value in table.items():
        if key not in known:
            raise UsageError(f"unknown key {key!r} in {where}{suggest(key, known)}")
        values[key] = _convert_toml_value(known[key], value, f"{key} in {where}" if where else key)
    return values


def _from_environment(known: Mapping[str, Any], section: str, environment: Mapping[str, str]) -> dict[str, Any]:
    prefix = f"DREAMFLEET_{section.upper()}_" if section else "DREAMFLEET_"
    values = {}
    for variable, text in environment.items():
        if not variable.startswith(prefix):
            continue
        if not section and variable.removeprefix(prefix).lower() not in known:
            continue  # belongs to another section
        key = variable.removeprefix(prefix).lower()
        if key not in known:
            names = [prefix + each.upper() for each in known]
            raise UsageError(f"unknown environment variable {variable}{suggest(variable, names)}")
        if text or _takes_empty(known[key]):  # else as if unset
            values[key] = _parse_text(known[key], text, variable)
    return values


def _convert_toml_value(hint: Any, value: Any, where: str) -> Any:
    """Convert a TOML value to the field's type."""
    base = without_none(hint)
    if get_origin(base) is tuple and isinstance(value, list):
        with suppress(UsageError):  # the error below is of the whole list
            return tuple(_convert_toml_value(get_args(base)[0], item, where) for item in value)
    if base is float and type(value) in (int, float):
        return float(value)
    if base is Path and isinstance(value, str) and value:
        return Path(value)
    if get_origin(base) is Literal and value in get_args(base):
        return value
    if isinstance(base, type) and type(value) is base:
        return value
    raise UsageError(f"{where} must be {_describe_type(base)}, not {value!r}")


def _parse_text(hint: Any, text: str, where: str) -> Any:
    """Convert the text of an environment variable to the field's type."""
    base = without_none(hint)
    if base is Path and base is not hint and not text:
        return None  # as if unset: an empty path would be the current folder
    if get_origin(base) is tuple:
        return tuple(_parse_text(get_args(base)[0], part, where) for part in text.split(",") if part)
    if base is bool and text in ("true", "false"):
        return text == "true"
    if base is not bool and base in (int, float, str, Path):
        try:
            return base(text)
        except ValueError:
            pass
    if get_origin(base) is Literal and text in get_args(base):
        return text
    raise UsageError(f"{where} must be {_describe_type(base)}, not {text!r}")


def _takes_empty(hint: Any) -> bool:
    """Whether an empty variable is a value: an empty text, an empty list, no path."""
    base = without_none(hint)
    return base is str or get_origin(base) is tuple or (base is Path and base is not hint)


def without_none(hint: Any) -> Any:
    """The type without `| None`."""
    if get_origin(hint) in (Union, types.UnionType):
        return next(option for option in get_args(hint) if option is not type(None))
    return hint


def _describe_type(base: Any) -> str:
    if get_origin(base) is Literal:
        return "one of " + ", ".join(get_args(base))
    if get_origin(base) is tuple:
        return f"a list of {KINDS[get_args(base)[0]].removeprefix('a ')}s"
    return KINDS[base]


def _flag(each: Field[Any]) -> str:
    return "--" + each.name.replace("_", "-")


def _default_text(each: Field[Any]) -> str:
    default = each.default if each.default is not MISSING else None
    shown = _flag(each) if default is True else default
    return "" if default in (None, (), False, "") else f" (default {shown})"


def _flag_options(each: Field[Any], hint: Any, text: str) -> dict[str, Any]:
    base = without_none(hint)
    options: dict[str, Any] = {"default": argparse.SUPPRESS, "dest": each.name, "help": text}
    if base is bool:
        return {**options, "action": argparse.BooleanOptionalAction}
    if get_origin(base) is tuple:
        return {**options, "nargs": "+", "action": _TupleAction, "metavar": METAVARS.get(each.name, each.name.upper())}
    if get_origin(base) is Literal:
        return {**options, "choices": get_args(base)}
    return {**options, "type": base, "metavar": METAVARS.get(each.name, "N" if base in (int, float) else "TEXT")}


class _TupleAction(argparse.Action):
    """Stores the values as a tuple, the type of the dataclass's field."""

    def __call__(self, _parser: Any, namespace: argparse.Namespace, values: Any, _flag: str | None = None) -> None:
        setattr(namespace, self.dest, tuple(values))


def _field_types(section: type[Any]) -> dict[str, Any]:
    """The type of each configurable field, by name."""
    hints = get_type_hints(section)
    return {each.name: hints[each.name] for each in configurable_fields(section)}


def configurable_fields(section: type[Any]) -> list[Field[Any]]:
    """The fields with a help text; only the code sets the others."""
    return [each for each in fields(section) if "help" in each.metadata]
