"""Configuration: frozen dataclasses from defaults, a preset, a TOML file, environment and flags, in this order.

A section is one dataclass: `[run]` in TOML, `DREAMFLEET_RUN_...` in the environment, its field names as flags. The
section without a name is the top of the file and `DREAMFLEET_...`. A key that no section knows is refused, with the
nearest one named. The field `preset` of a section, where it has one, names the preset.
"""

from __future__ import annotations

import argparse
import difflib
import tomllib
import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, Field, field, fields
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.regular_files import read_text

T = TypeVar("T")
Table = Mapping[str, Any]
MAX_BYTES = 1_000_000  # of a configuration file


def option(default: Any, text: str) -> Any:
    """A field with its default and the text that `--help` shows."""
    return field(default=default, metadata={"help": text})


def add_flags(
    parser: argparse.ArgumentParser,
    *sections: type[Any],
    only: Iterable[str] | None = None,
    texts: Mapping[str, str] | None = None,
    default: str | None = None,
) -> None:
    """A flag for each field of the sections, or for those named in `only`; absent flags leave no trace.

    A field without a help text has none.
    `texts` replaces a field's help; `default` is shown instead of the defaults, where these are not what counts.
    """
    wanted = None if only is None else frozenset(only)
    for section in sections:
        group = _group(parser, section.__name__.removesuffix("Config").lower())
        hints = get_type_hints(section)
        for each in _configurable_fields(section):
            if wanted is None or each.name in wanted:
                text = (texts or {}).get(each.name) or each.metadata["help"] + _shown_default(each, default)
                group.add_argument(_flag(each), **_flag_options(each, hints[each.name], text))


def _group(parser: argparse.ArgumentParser, title: str) -> argparse._ArgumentGroup:
    """The group of that title, which an earlier call may have made."""
    made = next((each for each in parser._action_groups if each.title == title), None)
    return made or parser.add_argument_group(title)


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
    """The section `name`, each key from the strongest source that has it; `UsageError` for an unknown key or value.

    Weaker than every other source is what `preset` finds under the name that the key of that name has; weaker still
    is `base`.
    """
    known = _field_types(section)
    chosen = given(section, name, file, environment)
    chosen.update({key: value for key, value in vars(flags or argparse.Namespace()).items() if key in known})
    named = chosen.get("preset")
    return section(**{**(base or {}), **(preset(named) if preset and named is not None else {}), **chosen})


def given(section: type[Any], name: str, file: Table | None, environment: Mapping[str, str] | None) -> dict[str, Any]:
    """What the file and the environment say of the section `name`, checked."""
    known = _field_types(section)
    table = (file or {}).get(name, {}) if name else {key: (file or {})[key] for key in known if key in (file or {})}
    return {
        **read_table(section, f"[{name}]" if name else "", table),
        **_from_environment(known, name, environment or {}),
    }


def read_table(section: type[Any], where: str, table: Table) -> dict[str, Any]:
    """The values of a table, each of its field's type; `UsageError` for what does not fit, saying `where`."""
    known = _field_types(section)
    return _from_table(known, where, table)


def read_toml(
    path: Path | None, tables: Iterable[str], top: Iterable[str] = (), arrays: Iterable[str] = ()
) -> dict[str, Any]:
    """A configuration file: its tables, arrays of tables, and the keys before the first of them; others are refused."""
    if path is None:
        return {}
    try:
        table = tomllib.loads(read_text(path, MAX_BYTES))
    except FileNotFoundError:
        raise UsageError(f"no configuration file at {path}") from None
    except (OSError, ValueError, RecursionError) as error:  # a number of 5,000 digits is no `TOMLDecodeError`
        raise UsageError(f"{path} cannot be read as TOML: {error}") from error
    known, keys, repeated = sorted(tables), sorted(top), sorted(arrays)
    for name, value in table.items():
        if name in keys:
            continue
        if name not in (*known, *repeated):
            what = f"table [{name}]" if isinstance(value, dict) else f"key {name!r}"
            raise UsageError(f"{path}: unknown {what}{suggestion(name, [*known, *repeated, *keys])}")
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
            raise UsageError(f"unknown key {key!r} in {where}{suggestion(key, known)}")
        values[key] = _convert_toml_value(known[key], value, f"{key} in {where}" if where else key)
    return values


def _from_environment(known: Mapping[str, Any], section: str, environment: Mapping[str, str]) -> dict[str, Any]:
    prefix = f"DREAMFLEET_{section.upper()}_" if section else "DREAMFLEET_"
    values = {}
    for variable, text in environment.items():
        if not variable.startswith(prefix):
            continue
        if not section and variable.removeprefix(prefix).lower() not in known:
            continue  # of another section
        key = variable.removeprefix(prefix).lower()
        if key not in known:
            names = [prefix + each.upper() for each in known]
            raise UsageError(f"unknown environment variable {variable}{suggestion(variable, names)}")
        values[key] = _parse_text(known[key], text, variable)
    return values


def _convert_toml_value(hint: Any, value: Any, where: str) -> Any:
    """A TOML value as the field's type."""
    base = _without_none(hint)
    if get_origin(base) is tuple and isinstance(value, list) and all(isinstance(item, str) for item in value):
        return tuple(value)
    if base is float and type(value) in (int, float):
        return float(value)
    if base is Path and isinstance(value, str):
        return Path(value)
    if get_origin(base) is Literal and value in get_args(base):
        return value
    if isinstance(base, type) and type(value) is base:
        return value
    raise UsageError(f"{where} must be {_describe_type(base)}, not {value!r}")


def _parse_text(hint: Any, text: str, where: str) -> Any:
    """Text of an environment variable or a flag as the field's type."""
    base = _without_none(hint)
    if base is Path and base is not hint and not text:
        return None  # as where nothing is said: an empty path would be the folder that one is in
    if get_origin(base) is tuple:
        return tuple(part for part in text.split(",") if part)
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


def _without_none(hint: Any) -> Any:
    """The type without its `| None`."""
    if get_origin(hint) in (Union, types.UnionType):
        return next(option for option in get_args(hint) if option is not type(None))
    return hint


def _describe_type(base: Any) -> str:
    if get_origin(base) is Literal:
        return "one of " + ", ".join(get_args(base))
    if get_origin(base) is tuple:
        return "a list of texts"
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "a text", Path: "a path"}
    return words[base]


def _flag(each: Field[Any]) -> str:
    return "--" + each.name.replace("_", "-")


def _shown_default(each: Field[Any], instead: str | None) -> str:
    default = each.default if each.default is not MISSING else None
    shown = "" if default in (None, (), False, "") else str(default)
    return f" (default {instead or shown})" if instead or shown else ""


def _flag_options(each: Field[Any], hint: Any, text: str) -> dict[str, Any]:
    base = _without_none(hint)
    options: dict[str, Any] = {"default": argparse.SUPPRESS, "dest": each.name, "help": text}
    if base is bool:
        return {**options, "action": argparse.BooleanOptionalAction}
    if get_origin(base) is tuple:
        return {**options, "nargs": "+", "action": _TupleAction, "metavar": each.name.upper()}
    if get_origin(base) is Literal:
        return {**options, "choices": get_args(base)}
    return {**options, "type": base, "metavar": "N" if base in (int, float) else base.__name__.upper()}


class _TupleAction(argparse.Action):
    """Stores what was given as a tuple, as the dataclass wants it."""

    def __call__(self, _parser: Any, namespace: argparse.Namespace, values: Any, _flag: str | None = None) -> None:
        setattr(namespace, self.dest, tuple(values))


def _field_types(section: type[Any]) -> dict[str, Any]:
    """The type of each field that can be said."""
    hints = get_type_hints(section)
    return {each.name: hints[each.name] for each in _configurable_fields(section)}


def _configurable_fields(section: type[Any]) -> list[Field[Any]]:
    """The fields that have a help text: others are a caller's alone."""
    return [each for each in fields(section) if "help" in each.metadata]


def suggestion(name: str, known: Iterable[str]) -> str:
    """The end of a sentence about an unknown name: the near one, or all of them."""
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1)
    return f": did you mean {near[0]!r}?" if near else f"; known are {', '.join(names)}"
