"""`dreamfleet collect`: drives as training data: random ones, controllers' or a run's."""

import argparse
from pathlib import Path

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_next
from dreamfleet.common.cli.presets import preset_help_text
from dreamfleet.common.cli.world_flags import add_world_flags, world_arguments
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.regular_files import is_file
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.host.stop_signals import stop_on_signals
from dreamfleet.worker.training.stages import StageReport
from dreamfleet.worker.training.stages.collect import (
    CollectRequest,
    ImportReport,
    ImportRequest,
    collect_drives,
    import_kept,
)

SUMMARY = "collect training data for a world model: random drives, drives of controllers, or rollouts that a run kept"
EXTRAS = ("worker",)
FIRST = "--preset --task --environment --episodes --steps --seed --jobs --controller --driver --from-run --json"


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


def make_request(args: argparse.Namespace) -> CollectRequest:
    """The drives that the flags ask for; `UsageError` for flags that do not go together."""
    from dreamfleet.worker.training.config_flags import given_values
    from dreamfleet.worker.training.data.collect_config import CollectConfig

    return CollectRequest(
        args.data, args.preset, args.task, world_arguments(args), given_values(CollectConfig, args), args.jobs,
        tuple(args.controller), args.runs_dir,
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Collect the missing drives, or import those of a run."""
    if args.from_run is not None:
        report: StageReport = _import(args)
    else:
        with stop_on_signals() as stop:
            report = collect_drives(make_request(args), stop)
    print_answer(args, str(report), **report.facts)
    trained = is_file(args.data / "vae.safetensors")  # `train_vae.CHECKPOINT`, whose module loads torch
    # Drives that are added to a trained VAE's are encoded by it.
    print_next(args, ("encode", "--data", args.data) if trained else ("train", "vae", "--data", args.data))
    return 0


def _import(args: argparse.Namespace) -> ImportReport:
    if args.controller:
        raise UsageError("--from-run drives nothing: omit --controller")
    if args.task or world_arguments(args):
        raise UsageError("the drives of --from-run say their world: omit --task and its flags")
    return import_kept(ImportRequest(args.data, args.from_run, args.runs_dir))
