"""`dreamfleet completion SHELL`: a script that completes verbs and flags in a shell."""

import argparse
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from dreamfleet.common.cli.command_line import GROUP, build_parser, load_verb
from dreamfleet.common.errors import DreamfleetError

SUMMARY = "print a script that completes verbs and flags in bash, zsh or fish"
EXTRAS = ("completion",)
PLACES = {
    "bash": "~/.local/share/bash-completion/completions/dreamfleet",
    "zsh": "_dreamfleet in a folder of $fpath",
    "fish": "~/.config/fish/completions/dreamfleet.fish",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    texts = "; ".join(f"{shell}: {path}" for shell, path in PLACES.items())
    parser.add_argument(
        "shell", metavar="SHELL", choices=tuple(PLACES), help=f"whose script; the file to write it to: {texts}"
    )


def run(args: argparse.Namespace) -> int:
    """Print the script; it needs no dreamfleet while it completes, so write it again after an update."""
    import shtab

    print(shtab.complete(_whole_parser(shtab.FILE), args.shell))
    return 0


def _whole_parser(completed_by_files: object) -> argparse.ArgumentParser:
    """A parser of all verbs and their flags; one that cannot be loaded is left out."""
    root = argparse.ArgumentParser(prog="dreamfleet")
    verbs: dict[str, Any] = {"": root.add_subparsers()}
    for point in sorted(entry_points(group=GROUP), key=lambda each: each.name):
        group, _, name = point.name.rpartition(".")
        if group not in verbs:
            verbs[group] = verbs[""].add_parser(group, help=f"verbs of {group}").add_subparsers()
        try:
            parser = build_parser(point.name, load_verb(point))
        except DreamfleetError:
            continue
        added = verbs[group].add_parser(name, help=parser.description, add_help=False)
        for action in parser._actions:
            if action.type is Path:
                action.complete = completed_by_files  # type: ignore[attr-defined]
            added._add_action(action)
    return root
