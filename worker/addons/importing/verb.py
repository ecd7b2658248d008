"""`dreamfleet import`: controllers, world models, agents and drives of other projects."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path, reporting_write_errors
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.printable import plural
from dreamfleet.worker.addons.importing import sources

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from dreamfleet.common.artifacts.controller import Controller

SUMMARY = "read a controller, a world model or drives of another project; no code in them is executed"
EXTRAS = ("train",)
LAYOUTS = ("dreamfleet", "wme", "article", "ctallec")  # and `Layout` of drives.py
# How their programs turn a controller's outputs into the action.
OPTIONS = {"article": '{"pedals": "half"}', "ctallec": '{"actions": "linear"}'}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "source", type=Path, metavar="SOURCE",
        help="a world model, a folder with vae.json and rnn.json or with vae/best.tar and mdrnn/best.tar. Drives: .npz "
        "or a folder of them. A controller: ctrl/best.tar, .json, .npy, .csv, .txt, or a folder that pycma wrote. An "
        "agent: AttentionAgent's model.npz",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=Path, required=True,
        help="the bundle or agent NAME.zip, the data folder, or the controller NAME.npz to write",
    )  # fmt: skip
    parser.add_argument(
        "--layout", choices=LAYOUTS,
        help="how a vector's numbers or a drive's steps lie (docs/reference/import.md); default of a vector: wme for "
        ".json with --bundle, else dreamfleet; a drive says it by its arrays",
    )  # fmt: skip
    like = parser.add_mutually_exclusive_group()
    like.add_argument("--bundle", metavar="BUNDLE", help="the world model that a vector's linear controller sees")
    like.add_argument(
        "--like",
        metavar="CONTROLLER",
        help="take inputs, outputs, task and world model of this controller, or of this run, for a vector",
    )
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Find out what the source is, convert it, and print what was written."""
    pin_thread_pools()
    if not args.source.exists():
        raise UsageError(f"nothing at {args.source}")
    if args.out.is_file() and args.out.resolve().is_relative_to(args.source.resolve()):
        raise UsageError(f"--out {args.out} would replace a file of the source: choose another")
    source: Path = args.source
    if source.is_dir() and sources.holds_checkpoints(source):
        return _import_world_model(args)
    sources.refuse_unreadable(source)
    if source.is_dir() and sources.holds_json_model(source):
        return _import_world_model(args)
    if agent := sources.find_attention_agent(source):
        return _import_agent(args, agent)
    if source.suffix == ".npz" or (source.is_dir() and sources.drive_paths(source)):
        return _import_drives(args)
    return _import_controller(args)


def _import_world_model(args: argparse.Namespace) -> int:
    from dreamfleet.worker.addons.importing.bundles import import_checkpoints, import_json_model

    _refuse_flags(args, "a world model", "layout", "bundle", "like")
    check_output_path(args.out)
    write = import_checkpoints if sources.holds_checkpoints(args.source) else import_json_model
    bundle = write(args.source, args.out)
    controller = sources.find_checkpoint(args.source, sources.CONTROLLER)
    take = shell_command("import", controller or "VECTOR.json", "--bundle", args.out, "--out", "controller.npz")
    text = (
        f"{bundle.path}: a world model of {bundle.manifest.task}, controllers of {bundle.controller_shape.size} "
        f"parameters, sha256 {bundle.sha256}; `{take}` takes a controller"
    )
    print_answer(args, text, bundle=bundle.path, sha256=bundle.sha256)
    return 0


def _import_agent(args: argparse.Namespace, path: Path) -> int:
    from dreamfleet.worker.addons.importing.attention_agent import import_attention_agent

    _refuse_flags(args, "an agent", "layout", "bundle", "like")
    check_output_path(args.out)
    agent = import_attention_agent(path)
    with reporting_write_errors(args.out):
        agent.save(args.out)
    text = f"{args.out}: {agent}; `{shell_command('evaluate', '--controller', args.out)}` scores it"
    not_read = len(sources.drive_paths(args.source)) - 1
    text += f"; {args.source} holds {not_read} other .npz, which were not read" * bool(not_read)
    print_answer(args, text, agent=args.out, sha256=agent.sha256, task=agent.task, not_read=not_read)
    return 0


def _import_drives(args: argparse.Namespace) -> int:
    from dreamfleet.worker.addons.importing.drives import import_drives

    _refuse_flags(args, "of drives", "bundle", "like")
    found = import_drives(args.source, args.out, layout=args.layout)
    layouts = " and ".join(found.layouts)
    text = f"{args.out}: {plural(found.drives, 'drive')}, {plural(found.steps, 'step')}, read as layout {layouts}; "
    data = ("--data", args.out, "--preset", "paper")
    text += f"`{shell_command('train', 'vae', *data)}` trains on them"
    if found.without_rewards:
        text += (
            f"; {found.without_rewards} hold no rewards: train with "
            f"`{shell_command('train', 'mdnrnn', *data, '--set', 'reward=none')}`"
        )
    print_answer(args, text, data=args.out, drives=found.drives, steps=found.steps,
           without_rewards=found.without_rewards)  # fmt: skip
    return 0


def _import_controller(args: argparse.Namespace) -> int:
    check_output_path(args.out)
    controller = _read_controller(args)
    with reporting_write_errors(args.out):
        controller.save(args.out)
    model = ("--bundle", args.bundle) if args.bundle else ()
    text = f"{args.out}: {controller}; `{shell_command('evaluate', '--controller', args.out, *model)}` scores it"
    print_answer(args, text, controller=args.out, sha256=controller.sha256, task=controller.task,
           parameters=len(controller.parameters))  # fmt: skip
    return 0


def _refuse_flags(args: argparse.Namespace, what: str, *flags: str) -> None:
    """`UsageError` for flags that such a source does not have."""
    if given := [f"--{each}" for each in flags if getattr(args, each) is not None]:
        raise UsageError(f"{args.source} is {what}: omit {' and '.join(given)}")


def _read_controller(args: argparse.Namespace) -> Controller:
    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.common.artifacts.controller import IMPORTED, Controller
    from dreamfleet.common.artifacts.driving import FIRST_WORLD
    from dreamfleet.worker.addons.importing.vectors import sees_cells, to_parameters, with_units

    checkpoint = sources.checkpoint_of(args.source)
    if checkpoint is not None and args.layout not in (None, "ctallec"):
        raise UsageError(f"{checkpoint} is of the layout ctallec: omit --layout")
    vector, world_command = _read_numbers(args.source, checkpoint)
    is_of_wme = args.source.suffix.lower() == ".json" and args.like is None  # else it lies as that run's vectors do
    layout = args.layout or ("wme" if is_of_wme else "dreamfleet")
    layout = layout if checkpoint is None else "ctallec"
    provenance = {IMPORTED: args.source.name, "layout": layout}
    if args.like is not None and layout == "ctallec":
        raise UsageError("a checkpoint's controller sees its own world model: give --bundle in place of --like")
    if args.like is not None:
        like = _find_like(args.like, args.runs_dir)
        parameters = to_parameters(vector, layout, like.shape)
        return replace(like, parameters=parameters, provenance=provenance)
    if args.bundle is None:
        raise UsageError(
            f"{args.source} holds {plural(len(vector), 'number')}: say what they control, by --bundle WORLD_MODEL "
            f"(which the controller sees; {world_command} makes it of another project's) or --like CONTROLLER_OR_RUN"
        )
    bundle = find_bundle(args.bundle)
    options = OPTIONS.get(layout, "") if bundle.manifest.task == FIRST_WORLD else ""
    driving = bundle.driving_of(options)
    shape = bundle.shape_of("zh", driving=driving)
    if layout == "wme" and sees_cells(bundle):
        vector = with_units(vector, bundle)
    return Controller(
        shape, to_parameters(vector, layout, shape), bundle.manifest.task, bundle.sha256, provenance, options,
        driving.version,
    )  # fmt: skip


def _read_numbers(source: Path, checkpoint: Path | None) -> tuple[NDArray[Any], str]:
    """A controller's vector, and the command that makes its world model; only a checkpoint needs torch."""
    if checkpoint is None:
        from dreamfleet.worker.addons.importing.vectors import read_vector

        return read_vector(source), "`dreamfleet import FOLDER --out world.zip`"
    from dreamfleet.worker.addons.importing.checkpoints import read_controller, world_command

    return read_controller(checkpoint), world_command(checkpoint)


def _find_like(name: str, runs_dir: Path) -> Controller:
    """A controller with the inputs, outputs, task and world model of `name`, a controller or a run."""
    import numpy as np

    from dreamfleet.common.artifacts.controller import Controller
    from dreamfleet.common.runs.lookup import find_controller
    from dreamfleet.common.runs.run_folder import RunFolder
    from dreamfleet.common.runs.run_paths import JOURNAL

    folder = next((each for each in (runs_dir / name, Path(name)) if (each / JOURNAL).is_file()), None)
    if folder is None or Path(name).is_file():
        return find_controller(name, runs_dir)[0]
    with RunFolder(folder) as run:  # one of submitted batches has no controller, and another none yet
        shape, spec = run.settings.controller, run.spec
    zeros = np.zeros(shape.size, np.float32)
    return Controller(shape, zeros, spec.task, spec.bundle, {}, spec.options, spec.world_version)
