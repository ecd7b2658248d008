"""`dreamfleet card`: a controller as a folder to publish."""

import argparse
from contextlib import ExitStack
from pathlib import Path

from dreamfleet.common.addons.evaluation_report import read_evaluation_report
from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.cli.progress import progress_bar
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.packages import check_modules
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.host.stop_signals import stop_on_signals
from dreamfleet.common.host.unseen_drawing import draw_unseen
from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
from dreamfleet.worker.addons.card.card_page import CardContents
from dreamfleet.worker.addons.recording.verb import MOST_STEPS

SUMMARY = "write a controller as a folder to publish: a model card, scores, a video, ONNX, a script without dreamfleet"
EXTRAS = ("worker", "views", "export")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("controller", metavar="CONTROLLER", help="a file, a run, or one that ships")
    parser.add_argument(
        "report", type=Path, nargs="?", metavar="REPORT", help="its evaluation, from `evaluate --out REPORT.json`"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="the folder to write, new or empty")
    parser.add_argument("--bundle", help="the world model (default: the one that the controller names)")
    parser.add_argument(
        "--steps", type=int, default=MOST_STEPS, help=f"steps of the video at most, 0: no video (default {MOST_STEPS})"
    )
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Write the folder, and print what is in it."""
    if args.steps < 0:
        raise UsageError("--steps must be 0 or more")
    pin_thread_pools()
    draw_unseen()
    from dreamfleet.worker.addons.card.card import write_card

    check_modules(("onnx", "matplotlib", "av"))
    controller, beside = find_controller(args.controller, args.runs_dir)
    report = None if args.report is None else read_evaluation_report(args.report)
    bundle = find_bundle_of(controller, args.bundle, beside)
    contents = CardContents(controller, bundle, report, Path(args.controller).stem)
    with stop_on_signals() as stop, ExitStack() as stack:
        bar = stack.enter_context(progress_bar("record", args.steps, "steps")) if args.steps else None
        files = write_card(contents, args.out, args.steps, bar.update if bar else lambda _steps: None, stop)
        if bar and contents.filmed:
            bar.end(contents.filmed.steps)
    without = "".join(f"; without {name}: {why}" for name, why in contents.missing.items())
    text = f"{args.out}: {', '.join(files)}{without}"
    print_answer(args, text, folder=args.out, files=files, missing=contents.missing)
    return 0
