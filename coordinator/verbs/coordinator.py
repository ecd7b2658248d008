"""`dreamfleet coordinator`: start or continue a run."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.config import Table, add_flags, choose_preset, load, read_toml
from dreamfleet.common.errors import UsageError
from dreamfleet.common.runs import default_runs_dir
from dreamfleet.common.session import DEFAULT_ENDPOINT, Network
from dreamfleet.coordinator.config import PRESETS, LimitsConfig, NetworkConfig, RunConfig

if TYPE_CHECKING:
    from dreamfleet.coordinator.main import RunRequest
    from dreamfleet.coordinator.run import Run
    from dreamfleet.coordinator.start import Start

SUMMARY = "start a run: CMA-ES decides, workers score"
EXTRAS = ()
SECTIONS = ("run", "limits", "network")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    name = parser.add_mutually_exclusive_group()
    name.add_argument("--run", dest="run_name", default="run", help="name of the new run (default run)")
    name.add_argument("--resume", metavar="RUN", help="continue this run from its journal")
    parser.add_argument("--runs-dir", type=Path, default=default_runs_dir(), help="where runs live (default runs)")
    parser.add_argument("--preset", help=f"settings to begin with: {', '.join(sorted(PRESETS))}")
    parser.add_argument(
        "--init",
        metavar="CONTROLLER",
        help="begin with these parameters instead of zeros: a file, a run, or what ships",
    )
    add_settings(parser)


def add_settings(parser: argparse.ArgumentParser) -> None:
    """The arguments of whatever serves a run."""
    parser.add_argument("--config", type=Path, help="TOML file with [run], [limits] and [network]")
    add_flags(parser, RunConfig, LimitsConfig, NetworkConfig)


def run(args: argparse.Namespace) -> int:
    """Serve the run until it ends; Ctrl-C leaves it to be continued."""
    from dreamfleet.coordinator.start import find_start

    if args.resume and args.init:
        raise UsageError(f"--init: run {args.resume} has begun; `dreamfleet fork {args.resume}` begins another from it")
    start = find_start(args.init, args.runs_dir) if args.init else None
    return serve(args, choose_preset(PRESETS, args.preset), start, args.resume)


def serve(args: argparse.Namespace, preset: Table, start: Start | None, resume: str | None = None) -> int:
    """Serve a run whose settings begin with `preset`, or continue one."""
    from dreamfleet.coordinator.main import RunRequest, serve_run

    logging.getLogger("dreamfleet.coordinator").setLevel(logging.INFO)
    file = read_toml(args.config, SECTIONS)
    sources: Any = {"flags": args, "environment": os.environ, "file": file}
    config = load(RunConfig, "run", preset=preset, **sources)
    limits = load(LimitsConfig, "limits", **sources)
    network = load(NetworkConfig, "network", **sources)
    _check_target(config, limits)
    listen = network.listen or (() if network.connect else (DEFAULT_ENDPOINT,))
    request = RunRequest(
        name=resume or args.run_name,
        runs_dir=args.runs_dir,
        config=None if resume else config,
        limits=limits,
        network=Network(listen, network.connect),
        beat=network.beat,
        mixed=network.mixed,
        start=start,
    )
    if resume:
        _refuse_frozen(args, file)
    run = serve_run(request, _stop_on_signals)
    _report(run, request)
    return 0 if run.ended is not None else 130


def _check_target(config: RunConfig, limits: LimitsConfig) -> None:
    if limits.target is not None and not config.evaluate_every:
        raise UsageError("--target is reached by an evaluated mean: give --evaluate-every too")


def _refuse_frozen(args: argparse.Namespace, file: dict[str, object]) -> None:
    given = [name for name in RunConfig.__dataclass_fields__ if name in vars(args)]
    if given or args.preset or "run" in file:
        what = ", ".join(given) or args.preset or "[run]"
        raise UsageError(
            f"{what}: frozen with run {args.resume}; `dreamfleet fork {args.resume}` begins another run from it"
        )


def _stop_on_signals(stop: Callable[[], None]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop())


def _report(run: Run, request: RunRequest) -> None:
    name, folder = request.name, request.runs_dir / request.name
    if run.ended is None:
        print(f"left run {name} open; continue it with: dreamfleet coordinator --resume {name}", file=sys.stderr)
        return
    best = run.best
    score = f"; its mean scored {best.mean:.1f} on {best.episodes} validation tracks" if best else ""
    print(f"run {name} ended after {run.ended}{score}; controller: {folder / 'controller.npz'}")
