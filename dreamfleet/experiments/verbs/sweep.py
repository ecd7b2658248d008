"""`dreamfleet sweep`: many runs that differ in a few settings, on one fleet."""

import argparse
import sys
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.cli.command_line import build_parser
from dreamfleet.common.cli.config import add_flags, load, read_table, read_toml
from dreamfleet.common.cli.global_config import add_global_flags, load_credentials
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_rows
from dreamfleet.common.errors import StoppedError, UsageError
from dreamfleet.common.files.locks import folder_lock
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.host.stop_signals import Stop, interrupted_by_signals, stop_on_signals
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.tasks import module_of
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.common.transport.network import Network
from dreamfleet.coordinator.settings import run_setup
from dreamfleet.coordinator.settings.config import DEFAULT_BUNDLE, RunConfig
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.experiments.local.kept_words import accept, check_announced, check_kept, chosen_code
from dreamfleet.experiments.local.local_run import free_port, load_parsed_flags, security_flags
from dreamfleet.experiments.started_run import check_settings, flag_words
from dreamfleet.experiments.sweep import summary
from dreamfleet.experiments.sweep.display import showing
from dreamfleet.experiments.sweep.folder import FIGURE, SETTINGS, StoredSweep, SweepFolder
from dreamfleet.experiments.sweep.plan import Sweep, SweepOptions, parse_vary, read_vary
from dreamfleet.experiments.sweep.runner import RunProgress, SweepFleet, SweepRunner
from dreamfleet.experiments.sweep.summary import RunResult

SUMMARY = "evolve with several seeds and settings on one fleet, and compare the settings"
EXTRAS: tuple[str, ...] = ()
FIRST = (
    "--run --vary --resume --parallel --workers --listen --connect --json --runs-dir --task --bundle --preset "
    "--population --episodes --generations --minutes"
)
SETTINGS_OF_RUNS = ("beat", "evaluation_share", "failure_limit", "share", "strict")  # of `NetworkConfig`
ENDPOINTS = ("listen", "connect")
# Flags of `coordinator` that a sweep sets for each run, or has for all of them.
OWN = (
    "run", "resume", "from", "listen", "connect", "runs-dir", "json", "config", "join", "access-dir", "insecure",
    "metrics-port",
)  # fmt: skip
MOST_EQUAL = 10  # pairs of settings with equal results that are named


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "file", nargs="?", type=Path, metavar="FILE.toml",
        help="a sweep as a file: run, parallel, workers, a table [vary], and a table [flags] of `coordinator`'s",
    )  # fmt: skip
    parser.add_argument("--run", dest="run_name", metavar="NAME", help="name of the sweep; its runs are NAME-seed1-...")
    parser.add_argument(
        "--vary", nargs="+", action="extend", default=[], metavar="SETTING=VALUES",
        help="what differs, by `coordinator`'s flags: seed=1..5 population=8,32 are ten runs; runs that differ in the "
        "seed alone repeat one setting",
    )  # fmt: skip
    parser.add_argument("--resume", metavar="NAME", help="continue this sweep: finished runs are not repeated")
    add_flags(parser, SweepOptions, only=("parallel", "workers"))
    texts = {
        "listen": "the sweep's router listens here, so that workers of other hosts may join (default a free port of "
        "this host alone)",
        "connect": "use this router, and the workers that it has, instead of an own one",
    }
    add_json_flag(parser)
    add_global_flags(parser, "listen", "connect", "runs_dir", "access_dir", texts=texts)
    add_flags(parser, NetworkConfig, only=("insecure",))
    parser.add_argument("--init", metavar="CONTROLLER", help="begin each run with this controller's parameters")
    add_flags(parser, RunConfig, LimitsConfig)
    add_flags(parser, NetworkConfig, only=SETTINGS_OF_RUNS)


@interrupted_by_signals()
def run(args: argparse.Namespace) -> int:
    """Serve a new sweep or resume one, then compare its settings."""
    file = read_toml(args.file, ("vary", "flags"), ("run", "parallel", "workers", "listen", "connect"))
    if args.resume:
        _refuse_settings(args, file)
        folder = SweepFolder(args.runs_dir, args.resume)
        stored = folder.read()
        check_kept(_words(stored), _code_of(stored), folder.path / SETTINGS)
        stored = replace(stored, options=_options(args, file, stored.options))
    else:
        options = _options(args, file, SweepOptions())
        sweep = _new_sweep(args, file)
        folder = SweepFolder(args.runs_dir, sweep.name)
        folder.check_new(sweep)
        stored = StoredSweep(sweep, check_runs(sweep, args.sources), options)
        accept(_words(stored), _code_of(replace(stored, tasks=())))
        check_announced(stored.tasks)
        accept(_words(stored), _code_of(stored))
    fleet = _fleet(args, stored.options)
    with folder_lock(folder.lock, "sweep of this name", "--runs-dir"), stop_on_signals() as stop:
        if not args.resume:
            folder.check_new(stored.sweep)
        folder.write(stored)
        progress = _serve(args, stored, folder, fleet, stop)
    return _report(args, stored.sweep, folder, progress)


def _options(args: argparse.Namespace, file: Mapping[str, Any], kept: SweepOptions) -> SweepOptions:
    """How to serve the sweep: flags over the file over what is kept of it. A new endpoint replaces both kept ones."""
    table = {name: file[name] for name in ("parallel", "workers", *ENDPOINTS) if name in file}
    table |= {name: [table[name]] for name in ENDPOINTS if isinstance(table.get(name), str)}
    given = read_table(SweepOptions, str(args.file), table)
    given |= {name: getattr(args, name) for name in ("parallel", "workers", "insecure") if hasattr(args, name)}
    given |= {name: getattr(args.global_config, name) for name in ENDPOINTS if name in args.given}
    replaced = {"listen": (), "connect": (), "insecure": False} if given.keys() & set(ENDPOINTS) else {}
    return replace(kept, **{**replaced, **given})


def _new_sweep(args: argparse.Namespace, file: Mapping[str, Any]) -> Sweep:
    name = args.run_name or file.get("run")
    if not isinstance(name, str):
        raise UsageError("name the sweep: give --run NAME, or run = 'NAME' in the file")
    vary = read_vary(file.get("vary", {})) | parse_vary(args.vary)
    given = {name: getattr(args, name) for name in _run_settings(args)}
    flags = (
        *check_settings({key.replace("-", "_"): value for key, value in file.get("flags", {}).items()}),
        *(word for key, value in given.items() for word in flag_words(key, value)),
    )
    return Sweep(name, vary, flags)


def check_runs(sweep: Sweep, sources: Mapping[str, Any]) -> tuple[str, ...]:
    """The tasks that workers of the sweep score; `UsageError` if `coordinator` would refuse the settings of a run.

    `sources` are those of the verb, as `complete_arguments` left them.
    """
    _check_own(sweep)
    parser = build_parser("coordinator", run_setup)
    tasks: dict[str, None] = {}
    checked: set[str] = set()
    for run in sweep.runs:
        try:
            parsed = parser.parse_all([*sweep.flags, *run.flags])
            config, _ = load_parsed_flags(parsed, sources)
            load(NetworkConfig, "network", **{**sources, "flags": parsed})
            if run.setting not in checked:
                checked.add(run.setting)
                tasks |= dict.fromkeys(_check_settings(config, has_start=getattr(parsed, "init", None) is not None))
        except UsageError as error:
            raise UsageError(f"run {run.name} of the sweep: {error}") from error
    return tuple(tasks)


def _check_own(sweep: Sweep) -> None:
    given = {*sweep.vary, *(flag.removeprefix("--").partition("=")[0] for flag in sweep.flags if flag[:2] == "--")}
    if taken := sorted(given & set(OWN)):
        raise UsageError(f"{taken[0]} is no setting that a sweep can give its runs: it sets it itself")


def _words(stored: StoredSweep) -> object:
    """What a sweep's processes do, as JSON stores it."""
    return to_plain(replace(stored, options=SweepOptions()))


def _code_of(stored: StoredSweep) -> dict[str, str]:
    """The modules that a sweep's words have its processes trust, by what names each."""
    _check_own(stored.sweep)
    found = {f"task {task!r}": module for task in stored.tasks if (module := module_of(task))}
    parser = build_parser("coordinator", run_setup)
    for run in stored.sweep.runs:
        found |= chosen_code(parser.parse_all([*stored.sweep.flags, *run.flags]))
    return found


def _check_settings(config: RunConfig, *, has_start: bool) -> list[str]:
    """Check the settings together; return the tasks that they name."""
    bundle = None if config.needs_no_bundle else find_bundle(config.bundle or DEFAULT_BUNDLE)
    if not has_start:  # a start point may name another world model
        freeze(config, bundle)
    return [each for each in (config.task, bundle and bundle.manifest.task) if each]


def _run_settings(args: argparse.Namespace) -> list[str]:
    """The settings of runs that are flags of this command line."""
    known = [each.name for section in (RunConfig, LimitsConfig) for each in fields(section)]
    return [name for name in (*known, *SETTINGS_OF_RUNS) if name in args.given] + (["init"] if args.init else [])


def _refuse_settings(args: argparse.Namespace, file: Mapping[str, Any]) -> None:
    given = [f"--{name.replace('_', '-')}" for name in _run_settings(args)]
    given += ["--vary"] if args.vary or "vary" in file or "flags" in file else []
    if given or args.run_name:
        raise UsageError(f"{', '.join(given) or '--run'}: a sweep that is resumed keeps its name and its settings")


def _fleet(args: argparse.Namespace, options: SweepOptions) -> SweepFleet:
    if options.connect:
        credentials = load_credentials(args, ("coordinator",))
        network = Network(connect=options.connect, credentials=credentials)
        return SweepFleet(network, options.workers or 0, options.parallel, False, security_flags(args))
    if args.global_config.join is not None:
        raise UsageError("a sweep's own router knows no join files: give --connect to a fleet with one, or omit --join")
    network = Network(options.listen or (f"tcp/127.0.0.1:{free_port()}",))
    network.check_open(insecure=options.insecure)
    workers = usable_cores() if options.workers is None else options.workers
    return SweepFleet(network, workers, options.parallel, True, ("--insecure",) if options.insecure else ())


def _serve(
    args: argparse.Namespace, stored: StoredSweep, folder: SweepFolder, fleet: SweepFleet, stop: Stop
) -> list[RunProgress]:
    sweep = stored.sweep
    runs, workers = plural(len(sweep.runs), "run"), plural(fleet.workers, "worker")
    join = shell_command("worker", "--any", "--connect", fleet.endpoint)
    what = f"{runs}, {fleet.parallel} at a time, {workers} here"
    print(f"sweep {sweep.name}: {what}; more join with: {join}", file=sys.stderr)
    try:
        with SweepRunner(stored, folder, fleet, args.config) as runner, showing(runner.progress) as update:
            runner.serve(stop, update)
            update()
    except StoppedError as error:
        joined = () if args.global_config.join is None else ("--join", args.global_config.join)
        again = shell_command("sweep", "--resume", sweep.name, "--runs-dir", args.runs_dir, *joined)
        raise StoppedError(f"{error}; finished runs and open ones are kept; continue with: {again}") from error
    return runner.progress


def _report(args: argparse.Namespace, sweep: Sweep, folder: SweepFolder, progress: list[RunProgress]) -> int:
    """Print the mean of each setting, write the figure, and name what failed."""
    results = summary.read_results(args.runs_dir, sweep.runs)
    failed, left = ([each for each in progress if each.state == state] for state in ("failed", "left open"))
    figure = _draw(folder, results)
    if args.json:
        print_answer(
            args, "", sweep=sweep.name, figure=figure, **summary.compare_settings(results),
            runs=[{"run": each.run.name, "setting": each.run.setting, "state": each.state, "why": each.text,
                   "scores": next((result.scores for result in results if result.name == each.run.name), {})}
                  for each in progress],
        )  # fmt: skip
    else:
        print_settings(results)
        if figure is not None:
            print(f"{figure}: learning curves by setting")
    for each in (*failed, *left):
        print(f"run {each.run.name} {each.state}: {each.text}", file=sys.stderr)
    return 1 if failed else StoppedError.exit_code if left else 0


def print_settings(results: list[RunResult]) -> None:
    """Print each setting's mean over its runs, and which settings gave the same."""
    shown = [each.in_values for each in results]
    if (kind := summary.judged_by(shown)) is None:
        return
    what = f"mean {summary.word_of(shown)} of the last generation" if kind == summary.FITNESS else kind
    heading = summary.with_goal(what, shown)
    means = summary.means(shown, kind)
    print_rows([{"setting": each.setting, "runs": each.runs, heading: each.text} for each in means])
    print("± is the standard error among runs")
    equal = summary.find_equal(results, kind)
    for sentence in equal[:MOST_EQUAL]:
        print(sentence)
    if len(equal) > MOST_EQUAL:
        print(f"and {len(equal) - MOST_EQUAL} more pairs of settings (--json lists them)")


def _draw(folder: SweepFolder, results: list[RunResult]) -> Path | None:
    """The figure's path; `None` if there is nothing to draw, or nothing to draw with."""
    path = folder.path / FIGURE
    try:
        from dreamfleet.experiments.sweep.figure import plot_sweep
    except ModuleNotFoundError:
        print("no figure: it needs pip install 'dreamfleet[views]'", file=sys.stderr)
        return None
    return path if plot_sweep(results, path) else None
