"""A measurement in a child of its own, on one thread."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dreamfleet.common.artifacts.bundle import Bundle


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of a verb that measures a world model."""
    parser.add_argument("--bundle", default="tiny", help="the world model (default tiny)")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")


def print_figures(measure: Callable[[Bundle], dict[str, Any]], args: argparse.Namespace) -> int:
    """Measure a bundle and print what comes of it."""
    from multiprocessing import get_context

    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.common.host.resource_limits import clear_library_settings, pin_thread_pools

    bundle = find_bundle(args.bundle)
    clear_library_settings()
    pin_thread_pools()
    # A child, for numpy's library reads its thread count once, as it loads, and the command line has loaded it.
    with get_context("spawn").Pool(1) as pool:
        figures = pool.apply(measure, (bundle,))
    if args.json:
        print(json.dumps(figures))  # noqa: T201 - a verb's output
    else:
        for name, value in figures.items():
            print(f"{name:>22}  {value}")  # noqa: T201 - as above
    return 0
