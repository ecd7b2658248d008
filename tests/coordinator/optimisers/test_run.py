"""A run under each optimiser against its journal: killed and continued, and where another one may begin."""

from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.protocol.messages import Result
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.settings.start import latest_mean_and_sigma
from tests.support.run_bench import SETTINGS, Bench

GENERATIONS = 6
OPTIMISERS = ["cma", "cmaes-lra", "cmaes-sep", "tests.support.optimisers:ParentsAndChildren"]


def drive(path, bundle, optimiser, restart_at=()):
    """Every population of a run, float32 as it travelled, and where a fork of it would begin."""
    shape = ControllerShape(features=3, actions=2)
    bench = Bench(
        path, bundle, replace(SETTINGS, controller=shape, population=6, collect_every=0, optimiser=optimiser),
        generations=GENERATIONS,
    )  # fmt: skip
    for generation in range(GENERATIONS):
        if generation in restart_at:
            bench.restart()
        while bench.run.state.ended is None and bench.run.generation.number == generation:
            for send in bench.run.fleet.dispatch(bench.now):
                for work in send.work:
                    fitness = float(np.frombuffer(work.vector, "<f4").sum())
                    bench.answer(Result(work.job.digest, fitness, 10, 0.1, None, None))
    assert bench.run.state.ended is not None
    bench.journal.close()
    with RunFolder(path) as stored:
        mean, sigma = latest_mean_and_sigma(stored)
        return [stored.candidate(each, 5).tobytes() for each in range(GENERATIONS)], mean.tobytes(), sigma


@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_a_run_that_was_killed_ends_with_the_same_bits(tmp_path, random_bundle, optimiser):
    whole = drive(tmp_path / "whole", random_bundle.path, optimiser)
    assert drive(tmp_path / "killed", random_bundle.path, optimiser, restart_at=(0, 1, 4)) == whole
    _, mean, sigma = whole
    assert np.frombuffer(mean).sum() > 0
    assert sigma > 0
