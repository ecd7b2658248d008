"""Flags of the stages' verbs that a user gives an experiment as one text: read by the verbs' own parsers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from dreamfleet.common.cli.command_line import parse_flags
from dreamfleet.worker.training.stages.bundle import BundleRequest
from dreamfleet.worker.training.stages.train import Model, TrainRequest
from dreamfleet.worker.verbs import bundle, train


def read_training(model: Model, data: Path, seed: int, *words: object) -> TrainRequest:
    """The training of a model with this seed by flags of `train`; of one that is given twice the latter counts."""
    request = train.make_request(parse_flags("train", train, (model, "--data", data, *words)))
    return replace(request, settings={**request.settings, "seed": seed})


def read_bundle(data: Path, out: Path, *words: object) -> BundleRequest:
    """The bundle `out` of a data folder by flags of `bundle`."""
    return bundle.make_request(parse_flags("bundle", bundle, ("--data", data, "--out", out, *words)))
