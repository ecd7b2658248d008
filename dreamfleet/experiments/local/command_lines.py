"""Command lines of coordinators and workers, as words behind `dreamfleet`. Pure.

Of a flag that is given twice, the latter counts.
"""

from collections.abc import Sequence
from pathlib import Path

Words = tuple[str, ...]
MOST_WORKERS = 1024  # processes of one slot


def command(*parts: object) -> Words:
    """A command line from words, numbers and paths."""
    return tuple(map(str, parts))


def options(**values: object) -> Words:
    """`--name value` of each value that is not None; `_` in a name is `-`."""
    given = {f"--{name.replace('_', '-')}": value for name, value in values.items() if value is not None}
    return command(*(word for pair in given.items() for word in pair))


def begin_run(
    name: str, runs_dir: Path, listen: Sequence[str], *flags: object, as_json: bool = True
) -> Words:  # fmt: skip
    """The coordinator of a new run."""
    json = ("--json",) if as_json else ()
    return command("coordinator", *flags, "--run", name, "--runs-dir", runs_dir, *json, "--listen", *listen)


def resume_run(name: str, runs_dir: Path, listen: Sequence[str], *flags: object) -> Words:
    """The coordinator of a run that was begun before."""
    return command("coordinator", "--resume", name, *flags, "--runs-dir", runs_dir, "--json", "--listen", *listen)


def worker(run: str, endpoint: str, slots: int, *more: object) -> Words:
    """A worker of one run, reached at `endpoint`."""
    return command("worker", "--connect", endpoint, "--run", run, "--slots", slots, *more)
