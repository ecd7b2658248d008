"""Configuration: frozen dataclasses from defaults, a preset, a TOML file, environment and flags, in this order.

A section is one dataclass: `[run]` in TOML, `DREAMFLEET_RUN_...` in the environment, its field names as flags. A key
that no section knows is refused, with the nearest one named.
"""

from __future__ import annotations

import argparse
import difflib
import tomllib
import types
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, Field, field, fields
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from dreamfleet.common.errors import UsageError

T = TypeVar("T")
Table = Mapping[str, Any]


def option(default: Any, text: str, *, alias: str = "") -> Any:
    """A field with its default and the text that `--help` shows; `alias` is a second flag for it."""
    return field(default=default, metadata={"help": text, "alias": alias})


def add_flags(parser: argparse.ArgumentParser, *sections: type[Any]) -> None:
    """A flag for each field of the sections; absent flags leave no trace in the namespace."""
    for section in sections:
        group = parser.add_argument_group(section.__name__.removesuffix("Config").lower())
        hints = get_type_hints(section)
        for each in fields(section):
            aliases = [alias] if (alias := each.metadata.get("alias")) else []
            group.add_argument(_flag(each), *aliases, **_flag_options(each, hints[each.name]))


def load(
    section: type[T],
    name: str,
    *,
    flags: argparse.Namespace | None = None,
    environment: Mapping[str, str] | None = None,
    file: Table | None = None,
    preset: Table | None = None,
) -> T:
    """The section `name`, each key from the strongest source that has it; `UsageError` for an unknown key or value."""
    known = {each.name: hint for each, hint in zip(fields(section), _hints(section), strict=True)}  # type: ignore[arg-type]
    chosen: dict[str, Any] = dict(preset or {})
    chosen.update(_from_table(known, name, (file or {}).get(name, {})))
    chosen.update(_from_environment(known, name, environment or {}))
    chosen.update({key: value for key, value in vars(flags or argparse.Namespace()).items() if key in known})
    return section(**chosen)


def read_toml(path: Path | None, sections: Iterable[str]) -> dict[str, Any]:
    """The tables of a configuration file; a table that is not among `sections` is refused."""
    if path is None:
        return {}
    try:
        table = tomllib.loads(path.read_text())
    except FileNotFoundError:
        raise UsageError(f"no configuration file at {path}") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"{path} cannot be read as TOML: {error}") from error
    known = sorted(sections)
    for name, value in table.items():
        if name not in known:
            raise UsageError(f"{path}: unknown table [{name}]{_nearest(name, known)}")
        if not isinstance(value, dict):
            raise UsageError(f"{path}: {name} must be a table, written [{name}]")
    return table


def choose_preset(presets: Mapping[str, Table], name: str | None) -> Table:
    """The preset of that name, empty without one; `UsageError` names those that exist."""
    if name is None:
        return {}
    if name not in presets:
        raise UsageError(f"unknown preset {name!r}: choose one of {', '.join(sorted(presets))}")
    return presets[name]


def _from_table(known: Mapping[str, Any], section: str, table: Table) -> dict[str, Any]:
    values = {}
    for key, value in table.items():
        if key not in known:
            raise UsageError(f"unknown key {key!r} in [{section}]{_nearest(key, known)}")
        values[key] = _fit(known[key], value, f"{key} in [{section}]")
    return values


def _from_environment(known: Mapping[str, Any], section: str, environment: Mapping[str, str]) -> dict[str, Any]:
    prefix = f"DREAMFLEET_{section.upper()}_"
    values = {}
    for variable, text in environment.items():
        if not variable.startswith(prefix):
            continue
        key = variable.removeprefix(prefix).lower()
        if key not in known:
            names = [prefix + each.upper() for each in known]
            raise UsageError(f"unknown environment variable {variable}{_nearest(variable, names)}")
        values[key] = _parse(known[key], text, variable)
    return values


def _fit(hint: Any, value: Any, where: str) -> Any:
    """A TOML value as the field's type."""
    base = _base(hint)
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
    raise UsageError(f"{where} must be {_describe(base)}, not {value!r}")


def _parse(hint: Any, text: str, where: str) -> Any:
    """Text of an environment variable or a flag as the field's type."""
    base = _base(hint)
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
    raise UsageError(f"{where} must be {_describe(base)}, not {text!r}")


def _base(hint: Any) -> Any:
    """The type without its `| None`."""
    if get_origin(hint) in (Union, types.UnionType):
        return next(option for option in get_args(hint) if option is not type(None))
    return hint


def _describe(base: Any) -> str:
    if get_origin(base) is Literal:
        return "one of " + ", ".join(get_args(base))
    if get_origin(base) is tuple:
        return "a list of texts"
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "a text", Path: "a path"}
    return words[base]


def _flag(each: Field[Any]) -> str:
    return "--" + each.name.replace("_", "-")


def _flag_options(each: Field[Any], hint: Any) -> dict[str, Any]:
    base = _base(hint)
    default = each.default if each.default is not MISSING else None
    shown = "" if default in (None, (), False, "") else f" (default {default})"
    options: dict[str, Any] = {"default": argparse.SUPPRESS, "dest": each.name, "help": each.metadata["help"] + shown}
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


def _hints(section: type[Any]) -> list[Any]:
    hints = get_type_hints(section)
    return [hints[each.name] for each in fields(section)]


def _nearest(name: str, known: Iterable[str]) -> str:
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1)
    return f": did you mean {near[0]!r}?" if near else f"; known are {', '.join(names)}"
