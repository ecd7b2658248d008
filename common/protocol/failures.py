"""What failed, in words, and what a worker's error says: its cause, and whether the host is at fault."""

from __future__ import annotations

from collections.abc import Sequence

HOST_PREFIX = "host: "
OF_FUNCTION = "ObjectiveError"  # the cause where a function raised, or returned no finite number


def failure_cause(error: str) -> str:
    """The part of an error that is equal for equal failures: the text before the first colon.

    >>> failure_cause("ValueError: array at 0x7f3a is not finite")
    'ValueError'
    """
    return error.partition(":")[0]


def error_text(error: str) -> str:
    """An error without its cause, if a function raised it: the text itself names the exception.

    >>> error_text("ObjectiveError: cost returned nan"), error_text("slot crashed (exit status 3)")
    ('cost returned nan', 'slot crashed (exit status 3)')
    """
    cause, _, text = error.partition(": ")
    return text if cause == OF_FUNCTION else error


def is_host_failure(error: str) -> bool:
    """Whether a shortage of the host (memory, disk, processes) ended the attempt.

    >>> is_host_failure("host: killed by SIGKILL")
    True
    """
    return error.startswith(HOST_PREFIX)


def describe_job(kind: str, generation: int | str, candidate: int | str, seeds: Sequence[int]) -> str:
    """What a job scores, in words, with its seeds.

    >>> describe_job("score", 7, 2, (1048576,))
    'candidate 7/2, seed 1048576'
    >>> describe_job("evaluate", 7, 0, (20003,))
    "the evaluation of generation 7's mean, seed 20003"
    """
    words = {
        "evaluate": f"the evaluation of generation {generation}'s mean",
        "collect": f"a kept rollout of generation {generation}'s mean",
    }
    return f"{words.get(kind, f'candidate {generation}/{candidate}')}, seed {', '.join(map(str, seeds))}"
