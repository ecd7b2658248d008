"""Verbs by their words."""

from importlib.metadata import entry_points

from dreamfleet.common.cli.command_line import GROUP, load_verb


def find_verb(words):
    """The verb that a command line begins with: its name, the verb, and the words behind it."""
    for length in (2, 1):
        name = ".".join(words[:length])
        for point in entry_points(group=GROUP, name=name):
            return name, load_verb(point), words[length:]
    raise AssertionError(f"no verb begins {words}")
