"""A world model from nothing: its stages, in order, in one data folder; and stages by the flags of their verbs."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from dreamfleet.common.cli.command_line import Configurable, build_parser
from dreamfleet.common.cli.global_config import read_arguments
from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.host.stop_signals import Stop, never_stop
from dreamfleet.common.printable import plural
from dreamfleet.worker.addons.bundles import verb as bundle
from dreamfleet.worker.training.stages import StageReport
from dreamfleet.worker.training.stages.bundle import BundleRequest, build_bundle
from dreamfleet.worker.training.stages.collect import CollectRequest, collect_drives
from dreamfleet.worker.training.stages.encode import EncodeRequest, encode_drives
from dreamfleet.worker.training.stages.train import Model, TrainRequest, train_model
from dreamfleet.worker.verbs import train

COLLECT, VAE, ENCODE, MDNRNN, BUNDLE = STAGES = ("collect", "train.vae", "encode", "train.mdnrnn", "bundle")
MORE = 4  # times as many updates as the VAE had are advised where it learnt too little


def parse_flags(name: str, verb: Configurable, words: Sequence[object]) -> argparse.Namespace:
    """What a verb's arguments are under these words, the file and the environment; `UsageError` for wrong ones."""
    args = build_parser(name, verb).parse_all(list(map(str, words)))
    read_arguments(args)
    return args


def read_training(model: Model, data: Path, seed: int, *words: object) -> TrainRequest:
    """The training of a model with this seed by flags of `train`; of one that is given twice the latter counts."""
    request = train.make_request(parse_flags("train", train, (model, "--data", data, *words)))
    return replace(request, settings={**request.settings, "seed": seed})


def read_bundle(data: Path, out: Path, *words: object) -> BundleRequest:
    """The bundle `out` of a data folder by flags of `bundle`."""
    return bundle.make_request(parse_flags("bundle", bundle, ("--data", data, "--out", out, *words)))


@dataclass(frozen=True)
class PipelineRequest:
    """What each stage shall make in the one data folder; `accepts_any_vae`: also one that learnt too little."""

    collect: CollectRequest
    vae: TrainRequest
    mdnrnn: TrainRequest
    bundle: BundleRequest
    accepts_any_vae: bool = False


def make_world_model(
    request: PipelineRequest, stop: Stop = never_stop,
    on_stage: Callable[[str, StageReport], None] = lambda _name, _report: None,
) -> dict[str, StageReport]:  # fmt: skip
    """Run the stages, each of which does what is left of it; `on_stage` gets each one's report at once.

    Errors are those of the stages, and `DreamfleetError` as in `check_vae`.
    """
    data = request.collect.data
    stages: dict[str, Callable[[Stop], StageReport]] = {
        COLLECT: partial(collect_drives, request.collect), VAE: partial(train_model, request.vae),
        ENCODE: partial(encode_drives, EncodeRequest(data)), MDNRNN: partial(train_model, request.mdnrnn),
        BUNDLE: partial(build_bundle, request.bundle),
    }  # fmt: skip
    reports = {}
    for name, stage in stages.items():
        reports[name] = stage(stop)
        on_stage(name, reports[name])
        if name == VAE and not request.accepts_any_vae:
            check_vae(data)
    return reports


def check_vae(data: Path) -> None:
    """`DreamfleetError` where the VAE is no better than the mean picture: an MDN-RNN would learn nothing."""
    from dreamfleet.worker.training.assemble import load_quality
    from dreamfleet.worker.training.checkpoint import load_progress
    from dreamfleet.worker.training.train_vae import CHECKPOINT

    figures = load_quality(data)
    error, mean = figures["reconstruction_error"], figures["mean_picture_error"]
    if error >= mean:
        updates = load_progress(data / CHECKPOINT)["update"]
        more = shell_command("train", "vae", "--data", data, "--updates", MORE * updates)
        raise DreamfleetError(
            f"the VAE in {data} is no better than the mean picture (squared error {error:g}, not below "
            f"{mean:g}) after {plural(updates, 'update')}: train it longer with `{more}`, then give this command "
            "again; --yes goes on with it"
        )
