"""Why an attempt at a job failed, as data and in words; and what a job scores, in words. Pages: troubleshooting.md."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from msgspec import Meta

from dreamfleet.common.schema.validation import Packed, Text

MAX_CAUSE = 128  # characters
FailureKind = Literal["host", "usage", "crash", "other"]
"""`host`: short of memory, disk or processes, which says nothing of the job. `usage`: asked for what it cannot do.
`crash`: the scoring process ended or was killed."""


class Failure(Packed, frozen=True):
    """Why an attempt at a job failed; `cause` is equal for equal failures, on every host and in every run."""

    text: Text  # for people
    # An exception's class, or fixed words: no number, path or address
    cause: Annotated[str, Meta(min_length=1, max_length=MAX_CAUSE)]
    kind: FailureKind = "other"

    @classmethod
    def of_host(cls, what: str) -> Failure:
        """A failure that the host is to blame for, and not the job."""
        return cls(f"host: {what}", "host", "host")

    @property
    def ends_process(self) -> bool:
        """Whether the attempt ended its process, or may have, so that a process that drives it again would end too."""
        return self.kind in ("crash", "host")


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
