"""Names that people try because other programs have them, or another verb here: the error names what to give."""

from __future__ import annotations

# What other programs call a verb of ours.
OTHER_NAMES = {
    "evolve": "coordinator",
    "help": "--help",
    "kill": "stop",
    "run": "coordinator",
    "search": "coordinator",
    "start": "coordinator",
}

# Flags that people look for in a verb, by its entry point and the flag.
FLAGS_ELSEWHERE = {
    ("evaluate", "--tracks"): "give --episodes N, the number of tracks",
    ("coordinator", "--workers"): "workers are programs of their own: `dreamfleet worker --run NAME --slots N`",
    ("coordinator", "--slots"): "slots are a worker's: `dreamfleet worker --run NAME --slots N`",
    ("coordinator", "--log-to"): "give DREAMFLEET_NETWORK_LOG_TO=tensorboard, or `log_to` in a file's [network]",
    ("worker", "--workers"): "give --slots N, the number of processes",
}
