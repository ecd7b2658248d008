"""`dreamfleet bundle`: freeze a trained world model into one file, and back."""

import argparse
from pathlib import Path

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.world_facts import EndRule
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_next
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path
from dreamfleet.worker.addons.bundles.extract import ExtractRequest, extract_models
from dreamfleet.worker.training.stages.bundle import RECORDED, BundleReport, BundleRequest, build_bundle

SUMMARY = (
    "freeze a trained world model into one file that workers fetch by its hash; --extract takes one apart, "
    "--from rounds one to eight bits"
)
EXTRAS = ("train",)
OF_DATA = ("recorded", "reward", "end", "measured", "with_weights")  # arguments of a bundle that is built from --data


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--data", type=Path, help="folder of the data set and its trained models")
    source.add_argument(
        "--from", dest="eight_bits", metavar="BUNDLE",
        help="round this world model, a file or one that ships, to eight bits: --out is faster, "
        "and controllers that were evolved on it drive by both",
    )  # fmt: skip
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--out", type=Path, metavar="FILE", help="the bundle to write, NAME.zip")
    what.add_argument(
        "--extract", metavar="BUNDLE",
        help="the other way: write the VAE and MDN-RNN of this bundle, a file or one that ships, into --data as "
        "checkpoints from which training can continue",
    )  # fmt: skip
    parser.add_argument("--with-weights", action="store_true", default=None, help="keep the training weights in it")
    parser.add_argument(
        "--recorded", type=int, metavar="N",
        help=f"recorded states at which dreams may begin, with the model's memory (default {RECORDED}; 0: none)",
    )  # fmt: skip
    parser.add_argument(
        "--measured", type=Path, nargs="+", default=[], metavar="FILE",
        help="answers of `inspect --json` (--probe, --losses, ...) about this world model, to keep in its manifest",
    )  # fmt: skip
    parser.add_argument(
        "--reward", choices=("survival", "label", "value"),
        help="what a dreamt step earns: survival, or the label or the value that is predicted (default: by the data)",
    )  # fmt: skip
    parser.add_argument(
        "--end", type=_end_rule, metavar="RULE",
        help="where dreams end: at a predicted probability from 0 to 1, or drawn, by chance (default drawn where the "
        f"reward is survival, else {EndRule().at})",
    )  # fmt: skip
    add_json_flag(parser)


def _end_rule(text: str) -> str:
    EndRule.parse(text)
    return text


def make_request(args: argparse.Namespace) -> BundleRequest:
    """The bundle of a data folder that the flags ask for."""
    recorded = RECORDED if args.recorded is None else args.recorded
    return BundleRequest(
        args.data, args.out, bool(args.with_weights), recorded, tuple(args.measured), args.reward, args.end
    )


def use_bundle(path: Path) -> tuple[tuple[object, ...], tuple[object, ...]]:
    """What to do with a world model: look into it, and evolve in it; the coordinator says how a worker joins."""
    return ("inspect", path), ("coordinator", "--run", "mine", "--bundle", path)


def run(args: argparse.Namespace) -> int:
    """Write the bundle and print its SHA-256, or write checkpoints and print their paths."""
    building = args.extract is None and args.eight_bits is None
    given = [f"--{name.replace('_', '-')}" for name in OF_DATA if getattr(args, name) not in (None, [])]
    if given and not building:
        source = "--extract" if args.eight_bits is None else "--from"
        raise UsageError(f"{given[0]} is of a bundle to build from --data: omit it or {source}")
    if args.eight_bits is not None and args.out is None:
        raise UsageError("--from writes a bundle: give --out FILE")
    if args.extract is not None and args.eight_bits is None:
        extracted = extract_models(ExtractRequest(args.extract, args.data))
        print_answer(args, str(extracted), **extracted.facts)
        return 0
    report = build_bundle(make_request(args)) if building else _round_to_eight_bits(args.eight_bits, args.out)
    print_answer(args, str(report), **report.facts)
    print_next(args, *use_bundle(report.bundle))
    return 0


def _round_to_eight_bits(name: str, out: Path) -> BundleReport:
    from dreamfleet.worker.addons.bundles.eight_bits import write_eight_bit_bundle

    check_output_path(out)
    return BundleReport.of(write_eight_bit_bundle(find_bundle(name), out))
