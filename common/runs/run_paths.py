"""Paths of runs on disk: the files in a run's folder, the list of runs, and the command that resumes one."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from dreamfleet.common.files.regular_files import is_folder
from dreamfleet.common.host.processes import shell_command

JOURNAL = "journal.sqlite"
BUNDLE = "bundle.zip"
CONTROLLER = "controller.npz"
ARCHIVE = "archive"
ROLLOUTS = "rollouts"


def default_runs_dir() -> Path:
    """The folder of all runs: `$DREAMFLEET_RUNS_DIR`, else `runs` in the current folder."""
    return Path(os.environ.get("DREAMFLEET_RUNS_DIR") or "runs")


def run_paths(runs_dir: Path) -> Iterator[Path]:
    """The folders of all runs, by name."""
    if not is_folder(runs_dir):
        return
    for journal in sorted(runs_dir.glob(f"*/{JOURNAL}")):
        yield journal.parent


def rollout_path(folder: Path, generation: int, episode: int) -> Path:
    """The file of a rollout that a run collected, in the format of data sets' episodes."""
    return folder / ROLLOUTS / f"{generation:06d}-{episode:04d}.npz"


def run_command(folder: Path, *verb: str, more: Iterable[object] = ()) -> str:
    """The shell command of a verb about the run in `folder`: another folder may hold one of its name."""
    return shell_command(*verb, folder.name, "--runs-dir", folder.parent, *more)


def resume_command(folder: Path, join: object = None, access_dir: Path | None = None, trust: Iterable[str] = ()) -> str:
    """The shell command that resumes the run in `folder`.

    `join` is a secured run's join file, `access_dir` its authority's folder where that is not the default, `trust`
    names modules to import: the journal keeps none of them.
    """
    joined = () if join is None else ("--join", join)
    access = () if join is None or access_dir is None else ("--access-dir", access_dir)
    return run_command(folder, "coordinator", "--resume", more=(*joined, *access, *trust_flag(trust)))


def trust_flag(modules: Iterable[str]) -> tuple[str, ...]:
    """The flag that has a command trust these modules, each once; none without a module."""
    named = tuple(dict.fromkeys(filter(None, modules)))
    return ("--trust", *named) if named else ()
