"""The parser of a verb: one-line errors that suggest what was meant, and help in two lengths."""

import argparse
import difflib
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any, NoReturn

from dreamfleet.common.cli.key_values import as_setting
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import did_you_mean

FLAGS_OF_ALL = frozenset({"--config", "--log-level", "--log-format", "--trust", "--quiet"})  # of every verb
MIN_LIKENESS = 0.65  # of an unknown flag and the one that is suggested


class Parser(argparse.ArgumentParser):
    """A verb's parser: each error is one line, and the one for an unknown flag suggests the nearest.

    `--help` shows the flags that most people need, `--help-all` all of them. A flag is written whole: a short form
    of today may mean another flag tomorrow.
    """

    def __init__(self, *, first: str = "", elsewhere: Mapping[str, str] | None = None, **more: Any) -> None:
        """`first` and `elsewhere` are a verb's `FIRST` and `ELSEWHERE`; `more` is as of `ArgumentParser`."""
        super().__init__(add_help=False, allow_abbrev=False, formatter_class=_Formatter, **more)
        self._first, self._elsewhere = first.split(), elsewhere or {}
        self.keys: dict[str, Mapping[str, str]] = {}  # texts of settings that are no flags, by the group's title
        self.add_argument("-h", "--help", action="help", help="show the first flags")
        self.add_argument("--help-all", action=_HelpAll, help="show all flags")

    def add_keys(self, title: str, texts: Mapping[str, str]) -> None:
        """Add settings for `--help-all` that `--set` takes and that are no flags, by their keys."""
        self.keys[title] = texts

    def error(self, message: str) -> NoReturn:
        """Raise a `UsageError`; argparse would print all flags first."""
        raise UsageError(f"{message}; `{self.prog} --help` lists the flags")

    def parse_all(self, words: Sequence[str]) -> argparse.Namespace:
        """Parse `words`; exits with an error on an unknown one."""
        try:
            args, unknown = self.parse_known_args(words)
        except UsageError:
            self._refuse_misspelt(words)  # perhaps its value was taken for a verb's word
            self._refuse_bare(words)
            raise
        if unknown:
            self._refuse(unknown, words)
        return args

    def _refuse_misspelt(self, words: Sequence[str]) -> None:
        """An error that suggests the nearest flag, if one of `words` is an unknown flag like a known one."""
        for word in words:
            flag, known = word.split("=")[0], self._option_string_actions
            if " " in word or flag in (*known, "--"):  # flags of another verb, given as one text
                continue
            if flag.startswith("--") and _near_flags(flag, known):
                self._refuse([word], words)

    def _refuse_bare(self, words: Sequence[str]) -> None:
        """An error that names the flag, if the first of `words` is a controller and stands without one."""
        takes_words = any(not each.option_strings for each in self._actions)
        if words and not words[0].startswith("-") and not takes_words and "--controller" in self._option_string_actions:
            raise UsageError(f"{words[0]!r} is no flag{did_you_mean([f'--controller {words[0]}'])}")

    def format_help(self) -> str:
        """The help text with the first flags; where some are left out it says how to see them."""
        hidden = [each for each in self._actions if self._is_hidden(each)]
        return self._format([each for each in self._actions if each not in hidden], len(hidden))

    def format_all_help(self) -> str:
        """The help text with all flags, and with the settings that are no flags."""
        return self._format(self._actions, 0)

    def _is_hidden(self, action: argparse.Action) -> bool:
        """Whether only `--help-all` shows it."""
        if action.required or not action.option_strings:
            return False
        if "--help-all" in action.option_strings:  # named at the end
            return True
        flags = set(action.option_strings)
        return flags.isdisjoint((*self._first, "--help")) if self._first else bool(flags & FLAGS_OF_ALL)

    def _format(self, shown: Sequence[argparse.Action], hidden: int) -> str:
        formatter = self._get_formatter()
        formatter.add_usage(" ".join(("%(prog)s", *self._needed(formatter), "[FLAG ...]")), [], [])
        formatter.add_text(self.description)
        for group in self._action_groups:
            formatter.start_section(group.title)
            formatter.add_arguments([each for each in group._group_actions if each in shown])
            formatter.end_section()
        for title, texts in self.keys.items() if not hidden else ():
            formatter.start_section(title)
            formatter.add_arguments([argparse.Action([], key, help=text) for key, text in texts.items()])
            formatter.end_section()
        if hidden:
            formatter.add_text(f"`{self.prog} --help-all` shows {hidden} more flags.")
        formatter.add_text(self.epilog)
        return formatter.format_help()

    def _needed(self, formatter: argparse.HelpFormatter) -> Iterator[str]:
        """The usage of the arguments that a command cannot do without, words before flags, and of optional words."""
        for action in self._actions:
            if not action.option_strings:
                yield formatter._format_args(action, action.dest).replace("%", "%%")
        for action in self._actions:
            if action.option_strings and action.required:
                yield _with_value(action, formatter)
        for group in self._mutually_exclusive_groups:
            if group.required:
                yield f"({' | '.join(_with_value(each, formatter) for each in group._group_actions)})"

    def _refuse(self, unknown: Sequence[str], words: Sequence[str]) -> NoReturn:
        before = words[words.index(unknown[0]) - 1] if unknown[0] in words[1:] else ""
        action = self._option_string_actions.get(before)
        if action is not None and action.nargs == 0 and _is_value(unknown[0]):
            raise UsageError(
                f"{before} takes no value, and {unknown[0]!r} stands behind it; `{self.prog} --help` lists the flags"
            )
        said = f"unrecognized arguments: {' '.join(unknown)}"
        for at, word in enumerate(unknown):
            if word.startswith("--") and (answer := self._describe_elsewhere(word, unknown[at + 1 :])):
                raise UsageError(answer)
        flags = [word.split("=")[0] for word in unknown if word.startswith("--")]
        near = [each for flag in flags for each in _near_flags(flag, self._option_string_actions)]
        if near:
            raise UsageError(f"{said}{did_you_mean(dict.fromkeys(near))}")
        self._refuse_bare(words)
        self.error(said)

    def _describe_elsewhere(self, word: str, following: Sequence[str]) -> str | None:
        """The answer to a flag of another verb, or to a setting of `--set` that is given as a flag."""
        flag, equals, value = word.partition("=")
        if other := self._elsewhere.get(flag):
            return f"{self.prog} has no {flag}: {other}"
        keys = {key for texts in self.keys.values() for key in texts}
        setting = as_setting(flag, (value,) if equals else tuple(takewhile(_is_value, following)))
        return f"{flag} is no flag but a setting: give --set {setting}" if setting.partition("=")[0] in keys else None

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        if action.option_strings and "--" in arg_strings:  # of `--flag=--`: Python 3.11 drops it and gives a list
            raise argparse.ArgumentError(action, "expected a value, not --")
        if action.type is Path and "" in arg_strings:  # would be the current folder
            raise argparse.ArgumentError(action, "expected a path, not an empty text")
        return super()._get_values(action, arg_strings)


class _Formatter(argparse.HelpFormatter):
    """Calls values that have no name of their own by their kind."""

    def _get_default_metavar_for_optional(self, action: argparse.Action) -> str:
        if action.type in (int, float):
            return "N"
        return "PATH" if action.type is Path else super()._get_default_metavar_for_optional(action)


class _HelpAll(argparse.Action):
    """Prints all flags and ends the program."""

    def __init__(self, option_strings: Sequence[str], dest: str, help: str) -> None:  # noqa: A002 - argparse's name
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        assert isinstance(parser, Parser)
        parser._print_message(parser.format_all_help(), sys.stdout)
        parser.exit()


def _with_value(action: argparse.Action, formatter: argparse.HelpFormatter) -> str:
    value = (
        ""
        if action.nargs == 0
        else f" {formatter._format_args(action, formatter._get_default_metavar_for_optional(action))}"
    )
    return f"{action.option_strings[0]}{value}".replace("%", "%%")


def _is_value(word: str) -> bool:
    return not word.startswith("--")


def _near_flags(flag: str, known: Collection[str]) -> list[str]:
    """The known flags that an unknown one shortens, or the one that is most like it: an equal beginning counts most."""
    longer = [each for each in known if each.startswith(flag)]
    if longer and flag != "--":
        return [flag] if flag in known else longer

    def likeness(other: str) -> float:
        begins = len(list(takewhile(lambda pair: pair[0] == pair[1], zip(flag[2:], other[2:], strict=False))))
        return difflib.SequenceMatcher(None, flag[2:], other[2:]).ratio() + 0.1 * min(begins, 4)

    best = max((each for each in known if each.startswith("--")), key=likeness, default="")
    return [best] if best and likeness(best) >= MIN_LIKENESS else []
