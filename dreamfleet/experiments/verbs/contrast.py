"""`dreamfleet lab contrast`: kinds of MDN-RNNs on equal data, several seeds each."""

import argparse
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from dreamfleet.common.artifacts.driving import FIRST_WORLD
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_rows
from dreamfleet.common.errors import StoppedError
from dreamfleet.common.files.locks import folder_lock
from dreamfleet.common.host.packages import check_modules
from dreamfleet.common.host.stop_signals import interrupted_by_signals, stop_on_signals
from dreamfleet.common.printable import plural
from dreamfleet.experiments.contrast import summary
from dreamfleet.experiments.contrast.config import KINDS, RUN_FLAGS, SEEDS, Contrast
from dreamfleet.experiments.contrast.summary import TrialResult
from dreamfleet.experiments.contrast.trials import LOCK, Trials
from dreamfleet.experiments.local.local_run import LocalFleet, parse_run_flags

SUMMARY = "train kinds of MDN-RNNs on equal data, several seeds each, evolve in each one's dream, and compare them"
EXTRAS = ("train",)
FIRST = "--kind --seeds --mdnrnn-flags --run-flags --local --json"
PACKAGES = ("gymnasium", "onnx", "onnxruntime", "safetensors", "torch")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    shown = ", ".join(f'{name} "{flags}"' for name, flags in KINDS)
    parser.add_argument("--data", type=Path, required=True, help="an encoded data set: all learn from it")
    parser.add_argument("--out", type=Path, required=True, help="folder of the trials; one that was begun is resumed")
    parser.add_argument(
        "--kind", nargs=2, action="append", default=[], metavar=("NAME", "FLAGS"),
        help="a kind by its flags of `train mdnrnn`, with the world's preset, as one text; each is "
        f"compared with the first (default {shown})",
    )  # fmt: skip
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS), help="of each kind (default 1 2 3)")
    parser.add_argument(
        "--mdnrnn-flags", default="", metavar="FLAGS", help="of every training: --mdnrnn-flags='--updates 300'"
    )
    parser.add_argument(
        "--run-flags", default=RUN_FLAGS, metavar="FLAGS",
        help=f"of every `coordinator`, whose preset is the world's unless another is named (default {RUN_FLAGS})",
    )  # fmt: skip
    parser.add_argument("--local", type=int, help="scoring processes (default one per core)")
    add_json_flag(parser)


@interrupted_by_signals()
def run(args: argparse.Namespace) -> int:
    """Run all trials that are left, and compare them."""
    kinds = tuple((name, flags) for name, flags in args.kind) or KINDS
    contrast = Contrast(kinds, tuple(args.seeds), args.mdnrnn_flags, args.run_flags)
    parse_run_flags(contrast.run_flags_in(FIRST_WORLD), args.sources, "lab contrast")  # wrong flags end it now
    file = ("--config", str(args.config)) if args.config else ()
    check_modules(PACKAGES)
    with folder_lock(args.out / LOCK, "contrast"), stop_on_signals() as stop:
        trials = Trials(contrast, args.data, args.out, lambda: LocalFleet.of((), args.local, file, ()), stop)
        outcomes = _run_trials(trials, contrast)
    _print_results(args, outcomes)
    return 0


def _run_trials(trials: Trials, contrast: Contrast) -> list[TrialResult]:
    console = Console(stderr=True, highlight=False)
    outcomes: list[TrialResult] = []
    try:
        trials.begin()
        with console.status("") as shown:
            for trial in contrast.trials:
                outcomes.append(trials.do(trial, shown.update))
                console.print(f"{trial.name} is finished", markup=False)
    except StoppedError as error:
        raise StoppedError(f"{error}; finished parts are kept, and the same command continues") from error
    return outcomes


def _print_results(args: argparse.Namespace, outcomes: list[TrialResult]) -> None:
    found, means = list(summary.differences(outcomes)), summary.means(outcomes)
    if args.json:
        parts = {
            "trials": [asdict(each) for each in outcomes],
            "means": [asdict(each) for each in means],
            "differences": [{"kind": k, "figure": f, **asdict(d), "clear": d.is_significant} for k, f, d in found],
        }
        print_answer(args, "", **parts)
        return
    rows = summary.rows(outcomes)
    print_rows(rows, right=tuple(rows[0])[1:-1], drop_order=("reward loss", "after 50", "AUC after 10", "parameters"))
    print()
    for each in means:
        print(f"{each.kind}, {summary.name_figure(each.figure)}: {each.text} over {plural(each.seeds, 'seed')}")
    first = outcomes[0].kind
    print("\n".join(("", *(summary.describe_difference(kind, first, figure, each) for kind, figure, each in found))))
