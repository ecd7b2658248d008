"""The command line: finds verbs in the entry-point group `dreamfleet.verbs` and runs one.

A verb is a module with `SUMMARY`, `EXTRAS`, `configure(parser)` and `run(args)`. One with many flags names those that
`--help` shows in a text `FIRST`, and what to give for flags that it lacks in a dictionary `ELSEWHERE`. A dot in its
name is a space on the command line: `train.vae` is `dreamfleet train vae`. Only the requested verb's module is loaded,
and it imports heavy packages in `run`. Pages: exit-codes.md, README.md.
"""

import argparse
import errno
import logging
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points, version
from importlib.resources import files
from pathlib import Path
from typing import NoReturn, Protocol

from dreamfleet.common.cli.parser import Parser
from dreamfleet.common.errors import DreamfleetError, MissingExtraError, UsageError
from dreamfleet.common.host.logs import configure_logging, report_failure
from dreamfleet.common.host.packages import GYMNASIUM, extra_of, wrong_version
from dreamfleet.common.host.reports import adopt_reports
from dreamfleet.common.host.standard_streams import discard_stdout, prepare_streams
from dreamfleet.common.host.stop_signals import interrupts
from dreamfleet.common.printable import did_you_mean, one_line, suggest

GROUP = "dreamfleet.verbs"
EXIT_INTERRUPTED = 130
# What other programs call a verb of ours.
OTHER_NAMES = {
    "evolve": "coordinator", "help": "--help", "kill": "stop", "run": "coordinator", "search": "coordinator",
    "start": "coordinator",
}  # fmt: skip
DESCRIPTION = "Evolve World-Models controllers on whatever machines you have."
EXIT_CODES = (
    "Exit codes: 0 done; 1 it failed, was refused, or the answer is no; 2 the command or a setting is wrong; 130 it "
    "was interrupted, or left a run that can be continued."
)


class Configurable(Protocol):
    """The part of a verb that builds its parser."""

    SUMMARY: str

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the verb's arguments."""


class Verb(Configurable, Protocol):
    """The interface of a verb's module."""

    EXTRAS: tuple[str, ...]  # extras of the distribution that it needs

    def run(self, args: argparse.Namespace) -> int:
        """Run the verb; returns the exit code."""


@dataclass
class SimpleVerb:
    """A verb made of two functions, where one module offers several: its entry point is `module:NAME`."""

    SUMMARY: str
    configure: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]
    EXTRAS: tuple[str, ...] = ()
    FIRST: str = ""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit code. An expected error becomes one line on stderr and a non-zero exit code."""
    prepare_streams()
    adopt_reports()
    configure_logging()
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        code = run_verb({point.name: point for point in entry_points(group=GROUP)}, words)
        sys.stdout.flush()
    except (KeyboardInterrupt, Exception) as error:
        code = _report(error)
    return code


def _report(error: BaseException) -> int:
    """Report why a verb failed; returns the exit code. An error that nobody expected is raised again."""
    if isinstance(error, DreamfleetError):
        report_failure(str(error))
        return error.exit_code
    if isinstance(error, MemoryError):
        what = f" ({one_line(str(error))})" if str(error) else ""
        report_failure(f"not enough memory on this host{what}: what was written before is whole; give it less to hold")
        return 1
    if isinstance(error, KeyboardInterrupt) or interrupts.seen:
        report_failure("interrupted")
        return EXIT_INTERRUPTED
    if isinstance(error, BrokenPipeError):  # `dreamfleet runs list | head`
        discard_stdout()
        return 0
    if not isinstance(error, OSError):
        if not (remedy := wrong_version(GYMNASIUM)):
            raise error
        report_failure(f"{type(error).__name__}: {one_line(str(error))}; {remedy}")
        return 1
    logging.getLogger("dreamfleet").debug("the error in full", exc_info=error)
    discard_stdout()
    report_failure(_describe_system_error(error))
    return 1


def _describe_system_error(error: OSError) -> str:
    """What the operating system refused, on which file."""
    if error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return "cannot write to stdout: no space left" if error.errno == errno.ENOSPC else str(error)


def run_verb(points: Mapping[str, EntryPoint], words: Sequence[str]) -> int:
    """Run the verb that `words` begin with, with the rest as its arguments; without a verb, show help and exit."""
    _check_current_folder()
    name = ".".join(words[:2]) if ".".join(words[:2]) in points else "".join(words[:1])
    if name not in points:
        _show_overview(points, words)
    verb = load_verb(points[name])
    args = build_parser(name, verb).parse_all(words[name.count(".") + 1 :])
    from dreamfleet.common.cli.global_config import complete_arguments

    complete_arguments(args)
    args.typed = tuple(words)
    try:
        with interrupts.on_ctrl_c():
            return verb.run(args)
    except ModuleNotFoundError as error:
        if not verb.EXTRAS:
            raise
        own = extra_of(error.name)  # such as a world's, beside the verb's
        wanted = ",".join((*verb.EXTRAS, own) if own and own not in verb.EXTRAS else verb.EXTRAS)
        raise MissingExtraError(
            f"the package {error.name!r} is not installed; this needs: pip install 'dreamfleet[{wanted}]'"
        ) from error


def _check_current_folder() -> None:
    """`UsageError` if the current folder was deleted: relative paths lead nowhere, and torch ends the process."""
    try:
        Path.cwd()
    except OSError as error:
        raise UsageError("the current folder is gone or closed to this user: change to another") from error


def build_parser(name: str, verb: Configurable) -> Parser:
    """Build the parser of one verb, with the flags that every verb has."""
    from dreamfleet.common.cli.global_config import add_common_flags

    spoken = name.replace(".", " ")
    first, elsewhere = getattr(verb, "FIRST", ""), getattr(verb, "ELSEWHERE", None)
    parser = Parser(
        prog=f"dreamfleet {spoken}", description=verb.SUMMARY, epilog=EXIT_CODES, first=first, elsewhere=elsewhere
    )
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
    """Show help or the version, or report why `words` name no verb; never returns."""
    first = words[0] if words else ""
    group = [name for name in points if name.startswith(f"{first}.")] if first else []
    spoken = list(words[: 2 if group else 1])
    if spoken and not spoken[-1].startswith("-") and (not group or len(spoken) == 2):
        raise UsageError(_unknown_verb_text(words, spoken, points))
    parser = _help_parser(f"dreamfleet {first}", group, points) if group else _Overview(points)
    parser.add_argument("--version", action="version", version=f"dreamfleet {version('dreamfleet')}")
    parser.parse_args(words[1:] if group else words)
    parser.error("name a verb; --help lists them")


class _Overview(argparse.ArgumentParser):
    """The parser of no verb: its help lists all verbs by what people do."""

    def __init__(self, points: Mapping[str, EntryPoint]) -> None:
        super().__init__(prog="dreamfleet", usage="dreamfleet VERB ...", allow_abbrev=False)
        self._points = points

    def format_help(self) -> str:
        from dreamfleet.common.cli.overview import overview

        text = overview(DESCRIPTION, EXIT_CODES, self._points, lambda name: _summary(self._points[name]))
        package = Path(str(files("dreamfleet")))
        pages = [folder / "docs" / "index.md" for folder in (package, package.parent)]  # of a wheel, of a checkout
        page = next((each for each in pages if each.exists()), None)
        return f"{text}\nDocuments\n  {page}\n" if page else text


def _help_parser(prog: str, names: Iterable[str], points: Mapping[str, EntryPoint]) -> argparse.ArgumentParser:
    """A parser whose help lists a group's verbs; one that cannot be loaded is marked as broken."""
    parser = argparse.ArgumentParser(prog=prog, description=DESCRIPTION, epilog=EXIT_CODES, allow_abbrev=False)
    verbs = parser.add_subparsers(metavar="VERB")
    for name in sorted(names):
        verbs.add_parser(name.rpartition(".")[2], help=_summary(points[name]).replace("%", "%%"))
    return parser


def _summary(point: EntryPoint) -> str:
    try:
        return load_verb(point).SUMMARY
    except DreamfleetError as error:
        return f"BROKEN: {error}"


def _unknown_verb_text(words: Sequence[str], spoken: Sequence[str], points: Iterable[str]) -> str:
    """The error of a command whose first words, `spoken`, name no verb: it suggests verbs that people may mean."""
    verbs = [name.replace(".", " ") for name in points]
    same = sorted(verb for verb in verbs if " " in verb and verb.split()[1] == spoken[-1])  # without its group
    near = suggest(" ".join(words[:2]), [verb for verb in verbs if " " in verb], likeness=0.8, listed=False)
    if not near and (meant := [OTHER_NAMES[words[0]]] if words[0] in OTHER_NAMES else same):
        near = did_you_mean(meant)
    near = near or suggest(" ".join(spoken), sorted({*verbs, *(verb.split()[0] for verb in verbs)}), listed=False)
    return f"unknown verb {' '.join(spoken)!r}{near or '; `dreamfleet --help` lists them'}"
