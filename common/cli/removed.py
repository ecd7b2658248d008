"""Names that verbs and flags once had, or have in other programs: the answer to such a command is the name here."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

REMOVED_VERBS = {
    "baseline evaluate": "evaluate --controller",
    "baseline record": "record --controller",
    "bench": "lab bench",
    "contrast": "lab contrast",
    "fork": "coordinator --from",
    "refit": "lab refit",
    "repeat": "verify run",
    "replay": "verify candidate",
    "reproduce": "verify report",
    "runs compare": "compare",
    "runs story": "story --journal",
    "subspace": "lab subspace",
    "unbundle": "bundle --extract",
    "up": "spawn --hosts",
}

# What other programs call a verb of ours.
OTHER_NAMES = {
    "evolve": "coordinator",
    "help": "--help",
    "kill": "stop",
    "run": "coordinator",
    "search": "coordinator",
    "start": "coordinator",
}

# By the verb's entry point and the flag: what to do instead.
REMOVED_FLAGS = {
    ("evaluate", "--data"): "name the training's folder as --controller FOLDER",
    ("record", "--data"): "name the training's folder as --controller FOLDER",
    ("runs.plot", "--fitness"): "give --kind fitness, which is the default of one run",
}

# Flags that people look for in a verb, and where they are.
FLAGS_ELSEWHERE = {
    ("evaluate", "--tracks"): "give --episodes N, the number of tracks",
    ("coordinator", "--workers"): "workers are programs of their own: `dreamfleet worker --run NAME --slots N`",
    ("coordinator", "--slots"): "slots are a worker's: `dreamfleet worker --run NAME --slots N`",
    ("coordinator", "--log-to"): "give DREAMFLEET_NETWORK_LOG_TO=tensorboard, or `log_to` in a file's [network]",
    ("worker", "--workers"): "give --slots N, the number of processes",
}


def describe_removed(words: Sequence[str]) -> str | None:
    """The answer to a command that begins with a removed verb, with the command to give instead; else None.

    >>> describe_removed(["replay", "night", "--candidate", "3/0"])
    '`replay` is now `verify candidate`: dreamfleet verify candidate night --candidate 3/0'
    """
    for length in (2, 1):
        old = " ".join(words[:length])
        if new := REMOVED_VERBS.get(old):
            command = shlex.join(("dreamfleet", *new.split(), *words[length:]))
            return f"`{old}` is now `{new}`: {command}"
    return None
