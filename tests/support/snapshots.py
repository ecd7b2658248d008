"""Snapshots of a run under test, and what they answer."""

import dataclasses
from collections import Counter

from dreamfleet.common.client.status import read_document
from dreamfleet.coordinator.service.snapshot import take_snapshot
from dreamfleet.coordinator.service.status import encode_part
from tests.support.run_bench import SETTINGS

SCORED = dataclasses.replace(SETTINGS, population=4, episodes=2, collect_every=0)


def score(bench, count, fitness=lambda job: job.candidate + job.episode / 2):
    """Answer `count` jobs, one after the other."""
    bench.fitness_of = fitness
    for _ in range(count):
        bench.step()


def snapshot_of(bench):
    return take_snapshot(bench.run, "night", Counter(), 0.0, bench.now)


def answered(snapshot, part="", **parameters):
    return read_document(encode_part(snapshot, part, {name: str(value) for name, value in parameters.items()}.get))
