"""`dreamfleet bench dream`: how near a dreamed step is to what the core can do."""

from __future__ import annotations

import argparse

SUMMARY = "measure dreamed steps a second, against their matrix products alone and against torch"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.bench.measurement import add_bundle_flags

    add_bundle_flags(parser)


def run(args: argparse.Namespace) -> int:
    """Measure on one thread and print."""
    from dreamfleet.worker.bench.dream import bench_dream
    from dreamfleet.worker.bench.measurement import print_figures

    return print_figures(bench_dream, args)
