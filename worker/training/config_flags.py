"""Flags that override a preset's training and layers, one per field."""

from __future__ import annotations

import argparse
import types
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from dreamfleet.common.cli.output import add_json_flag
from dreamfleet.common.cli.presets import preset_help_text
from dreamfleet.worker.training.presets import PRESETS

T = TypeVar("T")
FIXED = ("actions",)  # fields that the task determines


def add_training_flags(parser: argparse.ArgumentParser, model: Literal["vae", "mdnrnn"]) -> None:
    """Add the flags of a model's `train` verb."""
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--preset", help=preset_help_text("training"))
    parser.add_argument("--device", default="cpu", help="cpu, cuda, or auto (default cpu)")
    parser.add_argument("--continue-from", type=Path, metavar="FILE", help="begin from this checkpoint's weights")
    parser.add_argument(
        "--new", action="store_true",
        help="begin anew: delete the folder's checkpoint, its curve and the checkpoints of --keep-every",
    )  # fmt: skip
    parser.add_argument(
        "--summary",
        action="store_true",
        help="print layers and parameters without training; a model to continue from must have these layers",
    )
    parser.add_argument(
        "--tensorboard", type=Path, metavar="FOLDER", help="also write the losses there as TensorBoard events"
    )
    add_json_flag(parser)
    add_config_flags(parser, "training", {name: getattr(each, model) for name, each in PRESETS.items()})
    add_config_flags(parser, "layers", {name: getattr(each, f"{model}_layers") for name, each in PRESETS.items()})


def add_config_flags(parser: argparse.ArgumentParser, title: str, presets: Mapping[str, Any]) -> None:
    """Add a flag for each field of the presets' configuration; a flag that is not given sets no attribute.

    The help shows the first preset's value, which is the default, and those of presets that differ.
    """
    config = type(next(iter(presets.values())))
    group, hints = parser.add_argument_group(f"{title}, instead of the preset's"), get_type_hints(config)
    for each in fields(config):
        if each.name not in FIXED:
            flag, text = "--" + each.name.replace("_", "-"), each.metadata.get("help")
            defaults = _describe_defaults({name: getattr(preset, each.name) for name, preset in presets.items()})
            text = text and f"{text} ({defaults})" if defaults else text
            group.add_argument(flag, default=argparse.SUPPRESS, help=text, **_options(hints[each.name]))


def _describe_defaults(values: Mapping[str, Any]) -> str:
    """Describe a field's values: `default 1500; notebook 30000; article, paper 60000`; empty if all are empty."""
    names: dict[str, list[str]] = {}
    for name, value in values.items():
        plain = ("on" if value else "off") if isinstance(value, bool) else value
        said = " ".join(map(str, plain)) if isinstance(plain, tuple) else str(plain)
        names.setdefault(said, []).append(name)
    (first, _), *others = names.items()
    default = [f"default {first}"] if first else []
    return "; ".join((*default, *(f"{', '.join(each)} {said}" for said, each in others)))


def apply_flags(config: T, args: argparse.Namespace) -> T:
    """Return a preset's configuration with the given flags applied."""
    given = {each.name: getattr(args, each.name) for each in fields(config) if hasattr(args, each.name)}  # type: ignore[arg-type]
    given = {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
    return replace(config, **given)  # type: ignore[type-var]


def _options(hint: Any) -> dict[str, Any]:
    if get_origin(hint) in (Union, types.UnionType):
        hint = next(each for each in get_args(hint) if each is not type(None))
    if get_origin(hint) is Literal:
        return {"choices": get_args(hint)}
    if get_origin(hint) is tuple:
        return {"type": get_args(hint)[0], "nargs": "+", "metavar": "N"}
    if hint is bool:
        return {"action": argparse.BooleanOptionalAction}
    return {"type": hint, "metavar": "N"}
