"""Verbs by their words, and verbs that are run without the program around them: errors are raised."""

import argparse
from importlib.metadata import entry_points
from pathlib import Path

from dreamfleet.common.cli.command_line import GROUP, load_verb


def find_verb(words):
    """The verb that a command line begins with: its name, the verb, and the words behind it."""
    for length in (2, 1):
        name = ".".join(words[:length])
        for point in entry_points(group=GROUP, name=name):
            return name, load_verb(point), words[length:]
    raise AssertionError(f"no verb begins {words}")


def parse(verb, *words, runs_dir=Path("runs")):
    """The arguments of a verb."""
    parser = argparse.ArgumentParser()
    verb.configure(parser)
    parser.set_defaults(runs_dir=runs_dir)
    return parser.parse_args([str(each) for each in words])


def run_verb(verb, *words, **more):
    """Run a verb; its exit code."""
    return verb.run(parse(verb, *words, **more))
