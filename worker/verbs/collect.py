"""`dreamfleet collect`: drives as training data: random ones, controllers' or a run's."""

from __future__ import annotations

import argparse
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_next
from dreamfleet.common.cli.presets import preset_help_text
from dreamfleet.common.cli.world_flags import add_world_flags, world_arguments
from dreamfleet.common.errors import StoppedError, UsageError
from dreamfleet.common.files.regular_files import is_file
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.printable import plural

if TYPE_CHECKING:
    from dreamfleet.worker.scoring.rollout import DataWorld
    from dreamfleet.worker.training.data.collect_config import CollectConfig
    from dreamfleet.worker.training.data.pilot import Pilot

SUMMARY = "collect training data for a world model: random drives, drives of controllers, or rollouts that a run kept"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.training.config_flags import add_config_flags
    from dreamfleet.worker.training.presets import PRESETS

    parser.add_argument("--data", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--preset", help=preset_help_text("training"))
    add_world_flags(parser)
    add_config_flags(parser, "drives", {name: each.collect for name, each in PRESETS.items()})
    parser.add_argument("--jobs", type=int, default=usable_cores(), help="processes (default one per core)")
    parser.add_argument(
        "--controller", nargs="+", default=[], metavar="CONTROLLER",
        help="drive the missing episodes by these controllers, in turn: files, runs, or shipped ones (default random)",
    )  # fmt: skip
    parser.add_argument(
        "--from-run", metavar="RUN", help="drive nothing; import the rollouts that this run kept, each once"
    )
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Collect the missing drives."""
    if args.from_run is not None:
        return _import_run(args)
    for flag in ("noise", "spells"):
        if hasattr(args, flag) and not args.controller:
            raise UsageError(f"--{flag} is on a controller's actions: give --controller too")
    if hasattr(args, "driver") and args.controller:
        raise UsageError("--driver is who drives at random: omit it or --controller")
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.common.host.stop_signals import stop_on_signals
    from dreamfleet.worker.training.config_flags import apply_flags
    from dreamfleet.worker.training.data.collect import collect, missing_numbers
    from dreamfleet.worker.training.data.data_folder import resolve_preset, resolve_world, store_preset
    from dreamfleet.worker.training.data.dataset import check_no_foreign_files, existing_episodes
    from dreamfleet.worker.training.presets import find_preset

    check_no_foreign_files(args.data)
    world = resolve_world(args.data, args.task, world_arguments(args))
    preset = find_preset(resolve_preset(args.data, args.preset, world))
    config, pilots = apply_flags(_fit_pictures(preset.collect, world), args), _load_pilots(args)
    config.check_for(world)  # a refused command begins no data set
    frames = done = 0
    before = len(existing_episodes(args.data))
    total = before + len(missing_numbers(args.data, config))
    with progress_bar("collect", total, "episodes") as bar, stop_on_signals() as stop:
        bar.update(before)
        store_preset(args.data, preset.name, config.seed, world)
        with closing(collect(args.data, config, max(1, args.jobs), pilots, world)) as counts:
            for count in counts:
                frames, done = frames + count, done + 1
                bar.update(before + done)
                if stop():
                    break
    there = len(existing_episodes(args.data))  # with those that were written while the others stopped
    if there < total:
        raise StoppedError(
            f"stopped: {args.data} keeps {plural(there - before, 'new episode')}, {there} of {total} in all; the same "
            "command continues"
        )
    text = (
        f"{args.data}: {plural(done, 'new episode')} with {plural(frames, 'frame')}; {plural(there, 'episode')} in all"
    )
    print_answer(args, text, data=args.data, new_episodes=done, new_frames=frames, episodes=there)
    _print_next(args)
    return 0


def _print_next(args: argparse.Namespace) -> None:
    """Train on the drives; those that are added to a trained VAE's are encoded by it."""
    trained = is_file(args.data / "vae.safetensors")  # `train_vae.CHECKPOINT`, whose module loads torch
    print_next(args, ("encode", "--data", args.data) if trained else ("train", "vae", "--data", args.data))


def _fit_pictures(config: CollectConfig, world: DataWorld) -> CollectConfig:
    """The configuration with the pictures of a world that has only one size of them."""
    from dreamfleet.worker.training.data.dataset import find_world

    sizes = {each.size for each in find_world(*world).preprocessings.values()}
    return replace(config, picture=sizes.pop()) if len(sizes) == 1 else config


def _load_pilots(args: argparse.Namespace) -> tuple[Pilot, ...]:
    if not args.controller:
        return ()
    from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
    from dreamfleet.worker.training.data.pilot import Pilot

    found = []
    for name in args.controller:
        controller, beside = find_controller(name, args.runs_dir)
        bundle = find_bundle_of(controller, None, beside)
        if bundle is None:
            raise UsageError(f"controller {name} sees no world model: give one that was evolved with one")
        found.append(Pilot(controller, bundle))
    return tuple(found)


def _import_run(args: argparse.Namespace) -> int:
    from dreamfleet.common.runs.run_folder import open_run
    from dreamfleet.worker.training.data.collect import import_rollouts
    from dreamfleet.worker.training.data.dataset import existing_episodes

    if args.controller:
        raise UsageError("--from-run drives nothing: omit --controller")
    if args.task or world_arguments(args):
        raise UsageError("the drives of --from-run say their world: omit --task and its flags")
    with open_run(args.runs_dir, args.from_run) as stored:
        drives = stored.rollouts()
        if not drives:
            raise UsageError(f"run {args.from_run} has collected nothing: start a run with --collect-every")
    new = list(import_rollouts(args.data, drives))
    added = f"{plural(len(new), 'new episode')} with {plural(sum(new), 'frame')}"
    text = f"{args.data}: {added}, of {len(drives)} that {args.from_run} collected"
    print_answer(args, text, data=args.data, new_episodes=len(new), new_frames=sum(new), collected=len(drives),
           episodes=len(existing_episodes(args.data)))  # fmt: skip
    _print_next(args)
    return 0
