"""`dreamfleet bench policy`: how near a policy step is to what the core can do."""

from __future__ import annotations

import argparse

SUMMARY = "measure a policy step against this core's matrix rate and against torch"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.bench.measurement import add_bundle_flags

    add_bundle_flags(parser)


def run(args: argparse.Namespace) -> int:
    """Measure on one thread and print."""
    from dreamfleet.worker.bench.measurement import print_figures
    from dreamfleet.worker.bench.policy import bench_policy

    return print_figures(bench_policy, args)
