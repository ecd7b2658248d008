"""The jobs of a generation by its scoring parameters."""

import hashlib
from dataclasses import replace

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.scoring_params import scoring_params_at
from tests.support.samples import SPEC

SETTINGS = RunSettings(
    replace(SPEC, task="dream", temperature=1.0), ControllerShape(1, 3), 2, 2, 0.1, "diagonal", 1, 5, 16, driven=0.5
)


def test_jobs_are_named_by_vector_seed_and_the_specification_of_their_episode():
    params = scoring_params_at(0, SETTINGS, (), ())
    specs = [params.episode_spec(episode) for episode in range(2)]
    assert specs == [replace(SETTINGS.task, driven=True), SETTINGS.task]
    vectors, seeds = (b"x" * 12, b"y" * 12), (7, 8)
    identities = [hashlib.sha256(vector).digest() for vector in vectors]
    assert [*params.job_digests(vectors, seeds)] == [
        [spec.digest("score", identity, (seed,)) for spec, seed in zip(specs, seeds, strict=True)]
        for identity in identities
    ]
