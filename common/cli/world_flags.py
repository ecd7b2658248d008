"""The flags of `collect`, `pipeline` and `iterate` for a data set's world: the task, and what is seen of it.

`parse_options` of each recordable task takes them (`worker/tasks/recordable.py`); `IterateConfig` keeps them.
"""

import argparse
from typing import Any

from dreamfleet.common.artifacts.driving import FIRST_WORLD
from dreamfleet.common.cli.key_values import ENVIRONMENT_EXAMPLE, parse_arguments
from dreamfleet.common.worlds.shipped import WORLDS

ENVIRONMENT = "environment"
OPTIONS = (ENVIRONMENT, "observation", "crop", "size", "skip", "difference")


def add_world_flags(parser: argparse.ArgumentParser) -> None:
    """Add `--task` and a flag for each option of pictures; one that is not given is `None`."""
    group = parser.add_argument_group("the world, of a new data set")
    group.add_argument("--task", metavar="TASK", help=f"the world: {', '.join(WORLDS)}, gym:ENVIRONMENT or "
                       f"module:Task (default the data set's, of a new one {FIRST_WORLD})")  # fmt: skip
    group.add_argument(
        f"--{ENVIRONMENT}", nargs="+", metavar="KEY=VALUE", help="arguments of the world; values as in JSON"
    )
    group.add_argument(
        "--observation",
        metavar="KEY",
        help="picture among several, by its key; render: what is drawn; all: every frame of a stack",
    )
    group.add_argument("--crop", metavar="TOP:BOTTOM,LEFT:RIGHT", help="part of the picture that is seen, in pixels")
    group.add_argument("--size", type=int, metavar="N", help="height and width of the picture: 64 or 96 (default 64)")
    group.add_argument("--skip", type=int, metavar="N", help="steps of the world for which an action is held")
    group.add_argument(
        "--difference", action="store_true", default=None, help="show movement: grey now, grey before, their difference"
    )


def world_arguments(args: argparse.Namespace) -> dict[str, Any]:
    """The given options of the world by name, as a task's `parse_options` takes them."""
    given = {name: getattr(args, name) for name in OPTIONS if getattr(args, name) is not None}
    if ENVIRONMENT in given:
        given[ENVIRONMENT] = parse_arguments(f"--{ENVIRONMENT}", given[ENVIRONMENT], ENVIRONMENT_EXAMPLE)
    return given
