"""What a sweep keeps on disk, so that it can be resumed after everything was killed: its settings, before its runs."""

from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.files.regular_files import path_exists
from dreamfleet.common.protocol.keys import check_run_name
from dreamfleet.common.schema.validation import OPTIONAL, from_plain, to_plain
from dreamfleet.experiments.local.kept_document import read_document, write_document
from dreamfleet.experiments.local.local_run import has_begun
from dreamfleet.experiments.sweep.plan import Sweep, SweepOptions

SUFFIX = ".sweep"
SETTINGS, LOCK, FIGURE = "sweep.json", "sweep.lock", "learning.png"


@dataclass(frozen=True)
class StoredSweep:
    """A sweep as it is stored, with the tasks that its workers announce, and how it was served the last time."""

    sweep: Sweep
    tasks: tuple[str, ...]
    options: SweepOptions = field(default=SweepOptions(), metadata=OPTIONAL)


class SweepFolder:
    """The folder of a sweep's own files, beside those of its runs; with its dot, its name cannot be a run's."""

    def __init__(self, runs_dir: Path, name: str) -> None:
        self.runs_dir, self.path = runs_dir, runs_dir / f"{name}{SUFFIX}"
        self._name = name

    @property
    def lock(self) -> Path:
        """The lock file of whoever serves the sweep."""
        return self.path / LOCK

    def check_new(self, sweep: Sweep) -> None:
        """`UsageError` if the sweep, or a run of one of its names, exists."""
        if path_exists(self.path / SETTINGS):
            raise UsageError(
                f"sweep {self._name} exists in {self.runs_dir}: continue it with --resume {self._name}, or give "
                "another --run"
            )
        if taken := next((each.name for each in sweep.runs if has_begun(self.runs_dir, each.name)), None):
            raise UsageError(f"run {taken} exists in {self.runs_dir}: give the sweep another --run")

    def write(self, stored: StoredSweep) -> None:
        """Keep a sweep, and how it is served."""
        write_document(self.path / SETTINGS, to_plain(stored), "--runs-dir")

    def read(self) -> StoredSweep:
        """The sweep; `UsageError` if there is none of this name, `DatasetError` if it is damaged."""
        if (found := read_document(self.path / SETTINGS, partial(from_plain, StoredSweep))) is None:
            raise UsageError(f"no sweep {self._name} in {self.runs_dir}: begin it with --run {self._name}")
        return found


def find_sweep(runs_dir: Path, name: str) -> SweepFolder | None:
    """The sweep of this name, also given as its folder's; `None` if there is none, or if a run has the name."""
    try:
        folder = SweepFolder(runs_dir, check_run_name(name.removesuffix(SUFFIX)))
    except UsageError:  # a path, such as a report's
        return None
    if has_begun(runs_dir, name):
        return None
    return folder if path_exists(folder.path / SETTINGS) else None


def sweeps_of_runs(runs_dir: Path) -> dict[str, str]:
    """The sweep of each run that belongs to one, by names; a damaged sweep has none."""
    found: dict[str, str] = {}
    for path in sorted(runs_dir.glob(f"*{SUFFIX}")):
        with suppress(DreamfleetError):
            sweep = SweepFolder(runs_dir, path.name.removesuffix(SUFFIX)).read().sweep
            found |= dict.fromkeys((each.name for each in sweep.runs), sweep.name)
    return found
