"""The command line: finds verbs through the entry-point group `dreamfleet.verbs`; each side registers its own.

A verb is a module with `SUMMARY`, `EXTRAS`, `configure(parser)` and `run(args)`. A dot in its name is a space on the
command line: `train.vae` is `dreamfleet train vae`. Verbs import what is heavy when they run, and only the module of
the verb that is asked for is loaded.
"""

from __future__ import annotations

import argparse
import difflib
import errno
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points, version
from typing import NoReturn, Protocol

from dreamfleet.common.errors import DreamfleetError, MissingExtraError, UsageError
from dreamfleet.common.host.logs import configure_logging, report_failure

GROUP = "dreamfleet.verbs"
EXIT_INTERRUPTED = 130
LAST_STREAM = 2  # the number of stderr
DESCRIPTION = "Evolve World-Models controllers on whatever machines you have."
EXIT_CODES = (
    "Exit codes: 0 done; 1 it failed, was refused, or the answer is no; 2 the command or a setting is wrong; 130 it "
    "was interrupted, or left a run that can be continued."
)


class Configurable(Protocol):
    """What a verb's parser is built from."""

    SUMMARY: str

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the verb's arguments."""


class Verb(Configurable, Protocol):
    """What a verb's module offers."""

    EXTRAS: tuple[str, ...]  # of the distribution, without which it cannot run

    def run(self, args: argparse.Namespace) -> int:
        """Do it; the exit code."""


@dataclass
class SimpleVerb:
    """A verb made of two functions, where one module offers several: its entry point is `module:NAME`."""

    SUMMARY: str
    configure: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]
    EXTRAS: tuple[str, ...] = ()


class Parser(argparse.ArgumentParser):
    """A verb's parser: an unknown flag names the near one."""

    def parse_all(self, words: Sequence[str]) -> argparse.Namespace:
        """Parse `words`, all of which must be known."""
        args, unknown = self.parse_known_args(words)
        if unknown:
            self._refuse(unknown)
        return args

    def _refuse(self, unknown: Sequence[str]) -> NoReturn:
        flags = [word.split("=")[0] for word in unknown if word.startswith("--")]
        near = [each for flag in flags for each in difflib.get_close_matches(flag, self._option_string_actions, n=1)]
        hint = f"; did you mean {', '.join(dict.fromkeys(near))}?" if near else ""
        self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; an expected error is one line on stderr and an exit code that is not 0."""
    _open_closed_streams()
    configure_logging()
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        code = run_verb({point.name: point for point in entry_points(group=GROUP)}, words)
        sys.stdout.flush()
        return code
    except DreamfleetError as error:
        report_failure(str(error))
        return error.exit_code
    except KeyboardInterrupt:
        report_failure("interrupted")
        return EXIT_INTERRUPTED
    except BrokenPipeError:  # `dreamfleet runs list | head`
        _discard_stdout()
        return 0
    except OSError as error:
        if error.errno != errno.ENOSPC or error.filename is not None:
            raise
        _discard_stdout()
        report_failure("what this verb prints could not be written: no space left")
        return 1


def _open_closed_streams() -> None:
    """What `>&-` closed leads to nowhere: else the next file, such as a journal, would get what is printed."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= LAST_STREAM:
        os.set_inheritable(number, True)
    os.close(number)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115 - for good


def _discard_stdout() -> None:
    """What waits there cannot be written, and the interpreter would try again at its end."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def run_verb(points: Mapping[str, EntryPoint], words: Sequence[str]) -> int:
    """Find the verb that `words` begin with, parse the rest, run it; without a verb, `--help` lists them all."""
    name = ".".join(words[:2]) if ".".join(words[:2]) in points else "".join(words[:1])
    if name not in points:
        _show_overview(points, words)
    verb = load_verb(points[name])
    args = build_parser(name, verb).parse_all(words[name.count(".") + 1 :])
    from dreamfleet.common.cli.global_config import complete_arguments

    complete_arguments(args)
    try:
        return verb.run(args)
    except ModuleNotFoundError as error:
        if not verb.EXTRAS:
            raise
        wanted = ",".join(verb.EXTRAS)
        raise MissingExtraError(
            f"the package {error.name!r} is not installed; this needs: pip install 'dreamfleet[{wanted}]'"
        ) from error


def build_parser(name: str, verb: Configurable) -> Parser:
    """The parser of one verb, with the flags that every verb has."""
    from dreamfleet.common.cli.global_config import add_common_flags

    spoken = name.replace(".", " ")
    parser = Parser(prog=f"dreamfleet {spoken}", description=verb.SUMMARY, epilog=EXIT_CODES)
    verb.configure(parser)
    add_common_flags(parser)
    return parser


def load_verb(point: EntryPoint) -> Verb:
    """The verb of an entry point; `DreamfleetError` names its owner if it cannot be imported."""
    try:
        verb: Verb = point.load()
    except Exception as error:
        owner = point.dist.name if point.dist else point.module
        raise DreamfleetError(
            f"the verb {point.name!r} cannot be loaded from {point.value}: {type(error).__name__}: {error}; update or "
            f"uninstall {owner}"
        ) from error
    return verb


def _show_overview(points: Mapping[str, EntryPoint], words: Sequence[str]) -> NoReturn:
    """Answer words that name no verb: help, the version, or what is wrong with them."""
    first = words[0] if words else ""
    group = [name for name in points if name.startswith(f"{first}.")] if first else []
    spoken = list(words[: 2 if group else 1])
    if spoken and not spoken[-1].startswith("-") and (not group or len(spoken) == 2):
        raise UsageError(_unknown_verb_text(" ".join(spoken), points))
    parser = (
        _help_parser(f"dreamfleet {first}", group, points)
        if group
        else _help_parser("dreamfleet", _top_level_names(points), points)
    )
    parser.add_argument("--version", action="version", version=f"dreamfleet {version('dreamfleet')}")
    parser.parse_args(words[1:] if group else words)
    parser.error("name a verb; --help lists them")


def _top_level_names(points: Iterable[str]) -> list[str]:
    return sorted({name.partition(".")[0] for name in points})


def _help_parser(prog: str, names: Iterable[str], points: Mapping[str, EntryPoint]) -> argparse.ArgumentParser:
    """A parser whose help lists verbs and groups of verbs; a verb that cannot be loaded is listed as such."""
    parser = argparse.ArgumentParser(prog=prog, description=DESCRIPTION, epilog=EXIT_CODES)
    verbs = parser.add_subparsers(metavar="VERB")
    for name in sorted(names):
        spoken = name.rpartition(".")[2]
        if name in points:
            verbs.add_parser(spoken, help=_summary(points[name]).replace("%", "%%"))
        else:
            within = sorted(each.partition(".")[2] for each in points if each.startswith(f"{spoken}."))
            verbs.add_parser(spoken, help=f"{', '.join(within)}: `dreamfleet {spoken} --help` tells each")
    return parser


def _summary(point: EntryPoint) -> str:
    try:
        return load_verb(point).SUMMARY
    except DreamfleetError as error:
        return f"BROKEN: {error}"


def _unknown_verb_text(spoken: str, points: Iterable[str]) -> str:
    known = sorted({*(name.replace(".", " ") for name in points), *_top_level_names(points)})
    near = difflib.get_close_matches(spoken, known, n=1)
    return f"unknown verb {spoken!r}" + (f": did you mean {near[0]!r}?" if near else "; `dreamfleet --help` lists them")
