"""Command lines of coordinators and workers, as words behind `dreamfleet`, and flags that users give as one text. Pure.

Of a flag that is given twice, the latter counts.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from dreamfleet.common.errors import UsageError

Words = tuple[str, ...]


def command(*parts: object) -> Words:
    """A command line from words, numbers and paths."""
    return tuple(map(str, parts))


def options(**values: object) -> Words:
    """`--name value` of each value that is not None; `_` in a name is `-`."""
    return command(
        *(
            word
            for name, value in values.items()
            if value is not None
            for word in (f"--{name.replace('_', '-')}", value)
        )
    )


def begin_run(
    name: str, runs_dir: Path, listen: Sequence[str], *flags: object, world_model: Path | str | None = None,
    as_json: bool = True, **more: object,
) -> Words:  # fmt: skip
    """The coordinator of a new run; `flags` come first, so that `more`, such as `seed`, counts."""
    return command(
        "coordinator", *flags, "--run", name, *options(bundle=world_model, **more),
        *_run_place(runs_dir, listen, as_json=as_json),
    )  # fmt: skip


def resume_run(name: str, runs_dir: Path, listen: Sequence[str], *flags: object) -> Words:
    """The coordinator of a run that was begun before."""
    return command("coordinator", "--resume", name, *flags, *_run_place(runs_dir, listen, as_json=True))


def worker(run: str, endpoint: str, slots: int, *more: object) -> Words:
    """A worker of one run, reached at `endpoint`."""
    return command("worker", "--connect", endpoint, "--run", run, "--slots", slots, *more)


def split_flags(flag: str, text: str, owner: str = "", reserved: Sequence[str] = ()) -> Words:
    """Flags of another verb that `flag` was given as one text.

    `UsageError` if quotes do not match, or if one is in `reserved`, which `owner` sets itself.
    """
    try:
        words = tuple(shlex.split(text))
    except ValueError as error:
        raise UsageError(f"{flag} {text!r}: {error}") from error
    given = {word.partition("=")[0] for word in words if word.startswith("--")}
    if taken := [each for each in reserved if any(each.startswith(word) for word in given)]:  # a short form too
        raise UsageError(f"{flag}: omit {', '.join(taken)}, which {owner} sets itself")
    return words


def _run_place(runs_dir: Path, listen: Sequence[str], *, as_json: bool) -> Words:
    return command("--runs-dir", runs_dir, *(("--json",) if as_json else ()), "--listen", *listen)
