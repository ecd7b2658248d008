"""A run that a user's program starts on this host, watches generation by generation, and ends."""

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from itertools import count, takewhile
from pathlib import Path
from typing import Any, Self, Unpack
from weakref import finalize

from dreamfleet.common.addons.own_modules import trust_own_run
from dreamfleet.common.addons.status_card import show_live
from dreamfleet.common.cli.command_line import build_parser
from dreamfleet.common.cli.parser import Parser
from dreamfleet.common.client.client import Client
from dreamfleet.common.client.status import Status
from dreamfleet.common.errors import ConnectionFailedError, DreamfleetError, UsageError
from dreamfleet.common.files.atomic_write import reporting_unwritable_folder
from dreamfleet.common.files.locks import open_lock, try_lock
from dreamfleet.common.host.reports import WARNING
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.host.user_code import own_arguments
from dreamfleet.common.printable import suggest
from dreamfleet.common.protocol.keys import check_run_name
from dreamfleet.common.protocol.stop_kind import PauseKind
from dreamfleet.common.runs.records import StoredGeneration
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_paths import default_runs_dir
from dreamfleet.coordinator.addons.runs.stored_run import StoredRun
from dreamfleet.coordinator.settings import run_setup
from dreamfleet.experiments.local import command_lines
from dreamfleet.experiments.local.function_names import environment_for
from dreamfleet.experiments.local.kept_words import check_announced
from dreamfleet.experiments.local.local_run import ALONE, POLL_INTERVAL, LocalFleet, LocalRun, has_begun, task_flags
from dreamfleet.experiments.local.run_arguments import RunArguments

STARTING = "starting.lock"  # held while a program starts and serves a run
STATUS_INTERVAL = 2.0  # seconds between looks whether the run is paused
# Flags of `coordinator` that are no settings here: a secured fleet is started from the command line.
NO_SETTINGS = ("help", "help_all", "json", "connect", "join", "access_dir", "config", "quiet", "runs_dir")
Callback = Callable[[StoredGeneration, "StartedRun"], object]


class RunPausedError(DreamfleetError):
    """A run paused by itself; `errors` are those of its open jobs that failed."""

    def __init__(self, text: str, errors: tuple[str, ...]) -> None:
        super().__init__(text)
        self.errors = errors


class StartedRun(StoredRun):
    """A run that `start_run` started: iterate over its generations as they close.

    Leaving its `with`, `end`, and the end of this process, or of the thread that started it, end its coordinator and
    workers. A run that is left early stays open, and `start_run(resume=NAME)` continues it. Its journal can still be
    read afterwards.

    `address` is where further workers and `Client`s reach it, `client` a `Client` of it.
    """

    def __init__(self, path: Path, processes: LocalRun, address: str, client: Client | None, *, resumed: bool) -> None:
        """Of a `resumed` run, iterating begins with the generation that closes next."""
        super().__init__(path)
        self.address, self.client = address, client
        self._processes = processes
        self._seen = self.history() if resumed else []
        self._status_due = time.monotonic() + STATUS_INTERVAL
        self._end: Callable[[], object] = lambda: None
        finalize(self, self._journal.close)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the check of its task found before it began, such as a function whose values vary."""
        return tuple(map(str, self._processes.coordinator.reports(WARNING)))

    def end_with(self, stack: ExitStack) -> None:
        """Close this stack when the run is ended, or when nothing refers to it any more."""
        self._end = finalize(self, stack.close)

    def end(self) -> None:
        """End the coordinator and the workers; does nothing if they have ended."""
        self._end()

    def close(self) -> None:
        """End the run's processes and release its journal."""
        self.end()
        super().close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.end()

    def __iter__(self) -> Iterator[StoredGeneration]:
        """Each generation as soon as it is closed, until the run ends or is ended.

        After a recall (`dreamfleet bar`) numbers go back: what closes again comes again, in place of what came before.
        `DreamfleetError` if the coordinator or every worker fails or the run pauses by itself, `StoppedError` if
        somebody else stops it.
        """
        while True:
            over = self._processes.coordinator.exit_code is not None
            yield from self.new_generations()
            if over:
                break
            if self._is_live:  # else the loop's body has ended it
                if self.ended is None:  # else a busy host may kill a worker that takes long to exit
                    self._processes.check_workers()
                self._check_pause()
                time.sleep(POLL_INTERVAL)
        if self._is_live:
            self._processes.check_end()

    def new_generations(self) -> Iterator[StoredGeneration]:
        """What closed since the last one that came from here; from its first generation on what a recall changed."""
        last = self._seen[-1:]
        found = self.history(len(self._seen) - len(last))
        if repr(found[: len(last)]) == repr(last):  # as texts: NaN equals nothing
            found = found[len(last) :]
        else:
            found = self.history()
            pairs = zip(found, self._seen, strict=False)
            same = sum(1 for _ in takewhile(lambda pair: repr(pair[0]) == repr(pair[1]), pairs))
            del self._seen[same:]
            found = found[same:]
        for generation in found:
            self._seen.append(generation)
            yield generation

    def wait(self) -> Self:
        """Wait until the run has ended; errors as in iterating."""
        for _ in self:
            pass
        return self

    def show(self, pause: float = 1.0) -> None:
        """Show the live run in a notebook's cell until it has ended, as `Client.show`; errors as in iterating.

        Interrupting the cell ends the showing and not the run.
        """
        if self.client is not None and self._is_live and not show_live(self._watch(self.client, pause)):
            print(f"run {self.name} ended before it could be shown: {self.ended}")  # noqa: T201 - a notebook's cell

    def _watch(self, client: Client, pause: float) -> Iterator[Status]:
        try:
            for status in client.watch(self.name, pause):
                yield status
                if not status.is_over:
                    self._processes.check_workers()
        except ConnectionFailedError:  # it ended between two looks, or failed
            if self._processes.coordinator.exit_code is None:
                raise
        if self._is_live and self._processes.coordinator.exit_code is not None:
            self._processes.check_end()

    @property
    def _is_live(self) -> bool:
        """Whether its processes have not been ended from here."""
        return bool(getattr(self._end, "alive", False))

    def _check_pause(self) -> None:
        if self.client is None or time.monotonic() < self._status_due:
            return
        self._status_due = time.monotonic() + STATUS_INTERVAL
        try:
            status = self.client.status(self.name)
        except ConnectionFailedError:  # it is just ending
            return
        if status.state == "paused" and status.pauses != (PauseKind.BY_HAND,):  # as a sweep decides
            errors = tuple(text for each in status.failures for text in each.errors.values())
            raise RunPausedError(f"run {self.name} is paused: {status.why}; its logs are in {self.path}", errors)

    def _display(self) -> tuple[str, dict[str, object]]:
        headline, facts = super()._display()
        return headline, facts | {"address": self.address if self._is_live else None}


def start_run(
    workers: int | None = None, runs_dir: Path | str | None = None, **settings: Unpack[RunArguments]
) -> StartedRun:  # fmt: skip
    """Start a run on this host: its coordinator, and worker processes of one slot each (default: one a core).

    Settings are the flags of `dreamfleet coordinator` with `_` for `-`, such as `task`, `population`, `generations`,
    `bundle` or `init`; `run` is its name, `resume` one to continue. A list is a flag with several values, a dictionary
    one of KEY=VALUE, `True` and `False` a flag and its `--no-`. Workers are reached through a free port of this host;
    with `listen` further ones of other hosts may join, and `workers=0` starts none. A module in `task` is found where
    this program finds it, so it may lie beside your script.

    `UsageError` for a wrong setting, `DreamfleetError` with its last line if the coordinator fails.

    >>> import dreamfleet
    >>> with dreamfleet.start_run(
    ...     task="gym:CartPole-v1", population=4, episodes=2, generations=3, evaluate_every=0, workers=1
    ... ) as run:
    ...     for generation in run:
    ...         print(generation.number, generation.mean > 0)
    0 True
    1 True
    2 True
    >>> run.ended, run.controller().task
    ('3 generations', 'gym:CartPole-v1')
    """
    named = settings.get("task"), settings.get("optimiser"), _resumed_task(settings.get("resume"), runs_dir)
    return start_run_in(environment_for(named), workers, runs_dir, {**settings})


def _resumed_task(name: object, runs_dir: Path | str | None) -> str | None:
    """The task of the run to continue. `UsageError` if its module is not trusted: its folder may be a stranger's."""
    if not isinstance(name, str):
        return None
    with open_run(default_runs_dir() if runs_dir is None else Path(runs_dir), name) as run:
        uid, spec = run.uid, run.spec
    trust_own_run(uid, spec.task, spec.options)
    check_announced([spec.task])  # its workers trust the whole module, also of an environment
    return spec.task


def start_run_in(
    environment: Mapping[str, str], workers: int | None, runs_dir: Path | str | None, settings: dict[str, Any]
) -> StartedRun:
    """As `start_run`, with variables of `environment` for the processes, over this one's."""
    slots = usable_cores() if workers is None else workers
    if type(slots) is not int or not 0 <= slots <= command_lines.MOST_WORKERS:
        raise UsageError(f"workers must be a whole number from 0 to {command_lines.MOST_WORKERS}, not {workers!r}")
    flags, listen = check_settings(settings), settings.pop("listen", ())
    fleet = LocalFleet.of((listen,) if isinstance(listen, str) else tuple(listen), slots, (), ())
    folder = Path(default_runs_dir() if runs_dir is None else runs_dir).absolute()
    name = _run_name(settings, folder)
    words = command_lines.begin_run(name, folder, fleet.listen, *flags, as_json=False)
    if settings.get("resume"):
        words = command_lines.resume_run(name, folder, fleet.listen, *flags)
    processes = LocalRun(name, words, folder / name, {**os.environ, **ALONE, **own_arguments(), **environment})
    with ExitStack() as stack:
        stack.enter_context(_claim(folder / name))
        stack.callback(_discard_unless_begun, folder / name)
        stack.enter_context(processes)

        def start_workers(flags: tuple[str, ...]) -> None:
            for worker in (f"core-{number}" for number in range(slots)):
                more = ("--name", worker, "--exit-when-done", *flags)
                processes.start_worker(worker, command_lines.worker(name, fleet.local_endpoint, 1, *more))

        expected = task_flags(settings["task"]) if settings.get("task") and not settings.get("resume") else None
        if expected is not None:  # they load while the coordinator checks the task
            start_workers(expected)
        client, address = None, fleet.local_endpoint
        try:
            client = stack.enter_context(processes.connect(address))
        except DreamfleetError:
            if processes.coordinator.exit_code != 0:  # else a limit was reached before
                raise
        run = StartedRun(folder / name, processes, address, client, resumed=bool(settings.get("resume")))
        needed = None
        if run.client is not None:  # the flags by which a worker of this run announces its tasks
            modelled = (bundle.manifest.task,) if (bundle := run.bundle()) else ()
            check_announced(each for each in modelled if each != run.spec.task)
            needed = task_flags(run.spec.task, *modelled)
        if needed != expected:
            processes.end_workers()
            if needed is not None:
                start_workers(needed)
        run.end_with(stack.pop_all())
    return run


def evolve(
    callback: Callback | None = None, workers: int | None = None, runs_dir: Path | str | None = None,
    **settings: Unpack[RunArguments],
) -> StartedRun:  # fmt: skip
    """Run `start_run` to its end and return the run, whose processes have ended.

    `callback(generation, run)` is called as each generation closes; if it returns `False`, the run is left open there.
    An exception in it ends the processes too, and is raised.

    >>> import dreamfleet
    >>> means = []
    >>> run = dreamfleet.evolve(
    ...     lambda generation, run: means.append(generation.mean),
    ...     task="gym:CartPole-v1", population=4, episodes=2, generations=2, evaluate_every=0, workers=1,
    ... )
    >>> means == [each.mean for each in run.history()]
    True
    """
    with start_run(workers, runs_dir, **settings) as run:
        for generation in run:
            if callback is not None and callback(generation, run) is False:
                break
    return run


def check_settings(settings: Mapping[str, Any]) -> tuple[str, ...]:
    """The flags of these settings, without run, resume and listen; `UsageError` suggests a name for a wrong one."""
    parser = build_parser("coordinator", run_setup)
    known = setting_names(parser)
    for name in settings:
        if name not in known:
            raise UsageError(f"unknown setting {name!r}{suggest(name, known)}")
    words = {name: flag_words(name, value) for name, value in settings.items()}
    parser.parse_all([word for each in words.values() for word in each])
    return tuple(word for name, each in words.items() if name not in ("run", "resume", "listen") for word in each)


def setting_names(parser: Parser) -> list[str]:
    """The long names of a parser's flags as Python names."""
    flags = [flag for each in parser._actions for flag in each.option_strings[:2] if flag.startswith("--")]
    names = [flag.removeprefix("--").replace("-", "_") for flag in flags if not flag.startswith("--no-")]
    return [name for name in dict.fromkeys(names) if name not in NO_SETTINGS]


def flag_words(name: str, value: Any) -> tuple[str, ...]:
    """A setting as the words of a command line."""
    flag = name.replace("_", "-")
    if value is None:
        return ()
    if isinstance(value, bool):
        return (f"--{flag}" if value else f"--no-{flag}",)
    if isinstance(value, Mapping):
        value = [f"{key}={each if isinstance(each, str) else json.dumps(each)}" for key, each in value.items()]
    if isinstance(value, (list, tuple)):
        return (f"--{flag}", *map(str, value)) if value else ()
    return (f"--{flag}={value}",)


def _run_name(settings: Mapping[str, Any], folder: Path) -> str:
    """The run to resume, or the name of a new one; `UsageError` if that exists."""
    if resumed := settings.get("resume"):
        return check_run_name(resumed)
    name = check_run_name(settings.get("run") or _free_name(folder))
    if has_begun(folder, name):
        raise UsageError(f"run {name!r} exists in {folder}: continue it with resume={name!r}, or choose another name")
    return name


def _free_name(folder: Path) -> str:
    """A name by the time that no run has; its folder is made, so that no other program takes it."""
    now = f"run-{datetime.now():%Y%m%d-%H%M%S}"
    with reporting_unwritable_folder(folder, "choose another runs_dir"):
        folder.mkdir(parents=True, exist_ok=True)
        for number in count():
            with suppress(FileExistsError):
                name = f"{now}-{number}" if number else now
                (folder / name).mkdir()
                return name
    raise AssertionError("count ends never")


@contextmanager
def _claim(path: Path) -> Iterator[None]:
    """Keep other programs from starting this run, until its processes have ended; `UsageError` if one has."""
    with reporting_unwritable_folder(path, "choose another runs_dir"):
        path.mkdir(parents=True, exist_ok=True)
        file = open_lock(path / STARTING)
    with file:
        if not try_lock(file):
            raise UsageError(
                f"another program has started run {path.name} in {path.parent}: end it there first, or choose another "
                "name"
            )
        yield


def _discard_unless_begun(path: Path) -> None:
    """Remove the logs of a coordinator that made no run."""
    if not has_begun(path.parent, path.name):
        for each in (*path.glob("*.log"), path / STARTING):
            each.unlink(missing_ok=True)
        with suppress(OSError):
            path.rmdir()
