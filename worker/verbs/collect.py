"""`dreamfleet collect`: drives as training data, at random or from a run that kept its own."""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from dreamfleet.common.cores import cores
from dreamfleet.common.errors import StoppedError, UsageError
from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.presets import preset_help
from dreamfleet.common.site import offer

if TYPE_CHECKING:
    from dreamfleet.worker.training.pilot import Pilot

SUMMARY = "drive at random or by controllers, or take in what a run collected, as training data for a world model"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.training.flags import add_config_flags
    from dreamfleet.worker.training.presets import PRESETS

    parser.add_argument("--data", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--preset", help=preset_help("training"))
    add_config_flags(parser, "drives", {name: each.collect for name, each in PRESETS.items()})
    parser.add_argument("--jobs", type=int, default=cores(), help="processes (default one a core)")
    parser.add_argument(
        "--controller", nargs="+", default=[], metavar="CONTROLLER",
        help="who drives the episodes that are missing, in turn, instead of random drivers: files, runs, or what ships",
    )  # fmt: skip
    parser.add_argument("--from-run", metavar="RUN", help="drive nothing: take in what this run collected, each once")
    offer(parser, "runs_dir")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Collect what is missing."""
    if args.from_run is not None:
        return _take_in(args)
    for flag in ("noise", "spells"):
        if hasattr(args, flag) and not args.controller:
            raise UsageError(f"--{flag} is on a controller's actions: give --controller too")
    if hasattr(args, "driver") and args.controller:
        raise UsageError("--driver is who drives at random: leave it or --controller out")
    from dreamfleet.common.progress import progress_bar
    from dreamfleet.common.stopping import heeding_signals
    from dreamfleet.worker.training.collect import collect, missing, present
    from dreamfleet.worker.training.flags import changed
    from dreamfleet.worker.training.origin import agreed_preset, keep_preset
    from dreamfleet.worker.training.presets import find_preset

    preset = find_preset(agreed_preset(args.data, args.preset))
    config, pilots = changed(preset.collect, args), _pilots(args)
    frames = done = 0
    before = len(present(args.data))
    total = before + len(missing(args.data, config))
    with progress_bar("collect", total, "episodes") as bar, heeding_signals() as stop:
        bar.move(before)
        keep_preset(args.data, preset.name, config.seed)
        with closing(collect(args.data, config, max(1, args.jobs), pilots)) as counts:
            for count in counts:
                frames, done = frames + count, done + 1
                bar.move(before + done)
                if stop():
                    break
    there = len(present(args.data))  # with those that were written as the others were told to stop
    if there < total:
        raise StoppedError(
            f"stopped: {args.data} keeps {there - before} new episodes, {there} of {total} in all; the same command "
            "goes on"
        )
    text = f"{args.data}: {done} episodes, {frames} frames new; {there} episodes in all"
    answer(args, text, data=args.data, new_episodes=done, new_frames=frames, episodes=there)
    return 0


def _pilots(args: argparse.Namespace) -> tuple[Pilot, ...]:
    if not args.controller:
        return ()
    from dreamfleet.common.shelf import bundle_for, find_controller
    from dreamfleet.worker.training.pilot import Pilot

    found = []
    for name in args.controller:
        controller, beside = find_controller(name, args.runs_dir)
        bundle = bundle_for(controller, None, beside)
        if bundle is None:
            raise UsageError(f"controller {name} sees no world model: give one that was evolved with one")
        found.append(Pilot(controller, bundle))
    return tuple(found)


def _take_in(args: argparse.Namespace) -> int:
    from dreamfleet.common.runs import open_run
    from dreamfleet.worker.training.collect import present
    from dreamfleet.worker.training.intake import take_in

    if args.controller:
        raise UsageError("--from-run drives nothing: leave --controller out")
    with open_run(args.runs_dir, args.from_run) as stored:
        drives = stored.rollouts()
        if not drives:
            raise UsageError(f"run {args.from_run} has collected nothing: start a run with --collect-every")
    new = list(take_in(args.data, drives))
    text = f"{args.data}: {len(new)} episodes, {sum(new)} frames new, of {len(drives)} that {args.from_run} collected"
    answer(args, text, data=args.data, new_episodes=len(new), new_frames=sum(new), collected=len(drives),
           episodes=len(present(args.data)))  # fmt: skip
    return 0
