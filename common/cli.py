"""The command line: finds verbs through the entry-point group `dreamfleet.verbs`; each side registers its own.

A verb is a module with `SUMMARY`, `EXTRAS`, `configure(parser)` and `run(args)`. A dot in its name is a space on the
command line: `train.vae` is `dreamfleet train vae`. Verbs import what is heavy when they run.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Iterable, Sequence
from importlib.metadata import EntryPoint, entry_points, version
from typing import Protocol

from dreamfleet.common.errors import DreamfleetError, MissingExtraError

GROUP = "dreamfleet.verbs"
INTERRUPTED = 130


class Verb(Protocol):
    """What a verb's module offers."""

    SUMMARY: str
    EXTRAS: tuple[str, ...]  # of the distribution, without which it cannot run

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the verb's arguments."""

    def run(self, args: argparse.Namespace) -> int:
        """Do it; the exit code."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; an expected error is one line on stderr and an exit code that is not 0."""
    logging.basicConfig(format="%(asctime)s %(levelname)s %(name)s: %(message)s", level=logging.WARNING)
    parser = build_parser(entry_points(group=GROUP))
    args = parser.parse_args(argv)
    try:
        return run_verb(args)
    except DreamfleetError as error:
        print(f"dreamfleet: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("dreamfleet: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # `dreamfleet runs list | head`
        sys.stderr.close()
        return 0


def build_parser(points: Iterable[EntryPoint]) -> argparse.ArgumentParser:
    """The tree of verbs; their modules are import-light, so it needs no extra."""
    parser = argparse.ArgumentParser(
        prog="dreamfleet", description="Evolve World-Models controllers on whatever machines you have."
    )
    parser.add_argument("--version", action="version", version=f"dreamfleet {version('dreamfleet')}")
    branches = {"": parser.add_subparsers(metavar="VERB", required=True)}
    for point in sorted(points, key=lambda point: point.name):
        path, _, name = point.name.rpartition(".")
        if path not in branches:
            group = branches[""].add_parser(path, help=f"{path} ...: see `dreamfleet {path} --help`")
            branches[path] = group.add_subparsers(metavar=path.upper(), required=True)
        verb: Verb = point.load()
        leaf = branches[path].add_parser(name, help=verb.SUMMARY, description=verb.SUMMARY)
        verb.configure(leaf)
        leaf.set_defaults(verb=verb, extras=verb.EXTRAS)
    return parser


def run_verb(args: argparse.Namespace) -> int:
    """Run the chosen verb; a package that is not there becomes the line that installs it."""
    try:
        code: int = args.verb.run(args)
    except ModuleNotFoundError as error:
        if not args.extras:
            raise
        wanted = ",".join(args.extras)
        raise MissingExtraError(
            f"the package {error.name!r} is not installed; this needs: pip install 'dreamfleet[{wanted}]'"
        ) from error
    return code
