"""Flags, and keys of `--set`, that override a preset's training and layers, one per field."""

import argparse
from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from dreamfleet.common.cli.config import configurable_fields, read_settings, without_none
from dreamfleet.common.cli.parser import Parser
from dreamfleet.common.errors import UsageError

T = TypeVar("T")


def add_config_flags(
    parser: argparse.ArgumentParser, title: str, presets: Mapping[str, Any], only: Collection[str] | None = None,
    *, shows_default: bool = True,
) -> None:  # fmt: skip
    """Add a flag for each field of the presets' configuration, or for those in `only`.

    A flag that is not given sets no attribute. The help shows the first preset's value, which is the default.
    """
    first = next(iter(presets.values()))
    group, hints = parser.add_argument_group(f"{title}, instead of the preset's"), get_type_hints(type(first))
    for each in configurable_fields(type(first)):
        if only is None or each.name in only:
            default = _describe(getattr(first, each.name))
            text = each.metadata["help"] + (f" (default {default})" if default and shows_default else "")
            options = {"default": argparse.SUPPRESS, "help": text, **_options(hints[each.name])}
            group.add_argument("--" + each.name.replace("_", "-"), **options)


def add_settings_flag(
    parser: argparse.ArgumentParser, tables: Mapping[str, Sequence[Mapping[str, Any]]], flags: Collection[str]
) -> None:
    """Add `--set` for the fields of each table's configurations, each by preset, that are not in `flags`.

    `--help-all` lists the keys, with the values of all presets.
    """
    kinds = {table: [type(next(iter(each.values()))) for each in configs] for table, configs in tables.items()}
    parser.add_argument(
        "--set", nargs="+", action=_Set, tables=kinds, default=[], metavar="KEY=VALUE", dest="settings",
        help="any other setting instead of the preset's, such as hidden=128 or channels=32,64; --help-all lists the "
        f"keys, which a file for --config may hold too, in {' or '.join(f'[{name}]' for name in tables)}",
    )  # fmt: skip
    for table, configs in tables.items():
        texts = {}
        for presets in configs:
            for each in configurable_fields(type(next(iter(presets.values())))):
                defaults = _describe_defaults({name: getattr(preset, each.name) for name, preset in presets.items()})
                texts[each.name] = each.metadata["help"] + (f" ({defaults})" if defaults else "")
        if isinstance(parser, Parser):
            parser.add_keys(f"keys of --set, or in [{table}]", {k: v for k, v in texts.items() if k not in flags})


class _Set(argparse.Action):
    """Collects KEY=VALUE texts; `UsageError` for one that no table takes, or not that of the model given before."""

    def __init__(self, *, tables: Mapping[str, Sequence[type[Any]]], **more: Any) -> None:
        super().__init__(**more)
        self._tables = tables

    def __call__(self, _parser: Any, namespace: argparse.Namespace, values: Any, _flag: str | None = None) -> None:
        model = str(getattr(namespace, "model", ""))
        refusals = []
        for table in (model,) if model in self._tables else self._tables:
            try:
                read_settings(self._tables[table], table, {}, values)
                break
            except UsageError as error:
                refusals.append(error)
        else:
            raise refusals[-1]
        namespace.settings = [*namespace.settings, *values]


def apply_settings(configs: tuple[Any, ...], table: str, args: argparse.Namespace) -> tuple[Any, ...]:
    """Presets' configurations with what `given_settings` finds for them instead."""
    values = given_settings([type(each) for each in configs], table, args)
    return tuple(override(each, values) for each in configs)


def given_settings(kinds: Sequence[type[Any]], table: str, args: argparse.Namespace) -> dict[str, Any]:
    """The fields of these configurations that `--set`, the environment, [`table`] of the file, or flags give."""
    values = read_settings(kinds, table, getattr(args, "sources", {}), args.settings)
    return values | {name: value for kind in kinds for name, value in given_values(kind, args).items()}


def given_values(kind: type[Any], args: argparse.Namespace) -> dict[str, Any]:
    """The fields of a configuration for which flags were given."""
    given = {each.name: getattr(args, each.name) for each in fields(kind) if hasattr(args, each.name)}
    return {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}


def override(config: T, values: Mapping[str, Any]) -> T:
    """The configuration with those of the values that are its fields."""
    own = {each.name: values[each.name] for each in fields(config) if each.name in values}  # type: ignore[arg-type]
    return replace(config, **own)  # type: ignore[type-var]


def _describe(value: Any) -> str:
    """A value as `--set` takes it; empty for an empty one.

    >>> _describe((32, 64)), _describe(True), _describe(1e-3)
    ('32,64', 'true', '0.001')
    """
    if isinstance(value, bool):
        return str(value).lower()
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _describe_defaults(values: Mapping[str, Any]) -> str:
    """Describe a field's values: `default 1500; notebook 30000; article, paper 60000`; empty if all are empty."""
    names: dict[str, list[str]] = {}
    for name, value in values.items():
        names.setdefault(_describe(value), []).append(name)
    (first, _), *others = names.items()
    default = [f"default {first}"] if first else []
    return "; ".join((*default, *(f"{', '.join(each)} {said}" for said, each in others)))


def _options(hint: Any) -> dict[str, Any]:
    hint = without_none(hint)
    if get_origin(hint) is Literal:
        return {"choices": get_args(hint)}
    if get_origin(hint) is tuple:
        return {"type": get_args(hint)[0], "nargs": "+", "metavar": "N"}
    if hint is bool:
        return {"action": argparse.BooleanOptionalAction}
    return {"type": hint, "metavar": "N"}
