"""The document that `dreamfleet evaluate` writes: a controller's drives, and all that is needed to have them again."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from dreamfleet.common.bounds import LARGEST_FITNESS
from dreamfleet.common.codec import MalformedError, from_plain
from dreamfleet.common.errors import UsageError
from dreamfleet.common.evaluated import Drive, Evaluated
from dreamfleet.common.fields import OPTIONAL, known
from dreamfleet.common.files import read_text
from dreamfleet.common.messages import Length, Seconds

MARKS = (800, 900)  # scores of CarRacing that people ask about
ENOUGH = 100  # drives for a world to be called solved, as gymnasium's threshold has been understood
MOST_BYTES, MOST_DRIVES, MOST_SEED = 64 << 20, 10**5, 2**63
Drives = Annotated[tuple[Drive, ...], Length(1, MOST_DRIVES)]


@dataclass(frozen=True)
class Judgement:
    """Who drove, in what and where, and what came of it, one drive a seed."""

    name: str  # of the controller, as it was asked for
    controller: str  # SHA-256 of its parameters
    task: str  # that it was evolved in
    world: str  # the task that it was judged in: of one from a dream another
    bundle: str  # SHA-256; empty: none
    fingerprint: str  # of the host that judged
    version: str  # of dreamfleet
    seconds: Seconds
    drives: Drives
    judge: str = "gymnasium"
    #: mean score at which gymnasium has the world for solved; `None`: it says none
    threshold: float | None = field(default=None, metadata=OPTIONAL)

    @cached_property
    def evaluated(self) -> Evaluated:
        """The drives with their figures."""
        return Evaluated(self.drives)

    def to_json(self) -> str:
        """One line: the figures, then the fields, of which the drives are most."""
        return json.dumps({**figures(self.evaluated), **asdict(self)}, allow_nan=False)

    @property
    def told(self) -> str:
        """In words, for people: the score, how it was driven, and what by."""
        lines = (_score(self.evaluated), _manner(self.evaluated), self._solved, self._origin)
        return "\n".join(filter(None, lines))

    @property
    def _solved(self) -> str:
        """Whether that is gymnasium's mark, or how far from it; empty where the world has none."""
        if self.threshold is None:
            return ""
        beyond, count = self.evaluated.mean - self.threshold, len(self.drives)
        if beyond >= 0 and count >= ENOUGH:
            return f"solved: gymnasium's threshold is a mean of {self.threshold:g}"
        few = "" if count >= ENOUGH else f", on fewer than {ENOUGH} seeds"
        return (
            f"{abs(beyond):.1f} {'above' if beyond >= 0 else 'below'} gymnasium's threshold of {self.threshold:g}{few}"
        )

    @property
    def _origin(self) -> str:
        model = f", world model {self.bundle[:12]}" if self.bundle else ""
        made = f"{self.evaluated.steps:,} environment steps in {self.seconds:.0f} s"
        return f"{made}; controller {self.controller[:12]}{model}; dreamfleet {self.version}"


def figures(evaluated: Evaluated) -> dict[str, Any]:
    """What is told of drives together; `error`, `finished`, `speed` and `braking` may be `None`."""
    names = ("mean", "std", "error", "median", "least", "most", "steps", "finished", "speed", "braking")
    found: dict[str, Any] = {"n": len(evaluated.drives), **{name: getattr(evaluated, name) for name in names}}
    found |= {f"above_{mark}": evaluated.above(mark) for mark in MARKS}
    return {**found, "scores": evaluated.scores, "seeds": evaluated.seeds}


def read_judgement(path: Path) -> Judgement:
    """What `evaluate --out` wrote; `UsageError` for anything else."""
    try:
        found = from_plain(Judgement, known(Judgement, json.loads(read_text(path, MOST_BYTES))))
        _check(found.drives)
        return found
    except FileNotFoundError:
        raise UsageError(f"no report at {path}: `dreamfleet evaluate --out {path}` writes one") from None
    except (OSError, ValueError, TypeError, MalformedError, RecursionError) as error:
        raise UsageError(f"{path} is no report of `dreamfleet evaluate --out` ({error}): write it again") from error


def check_fits(first_seed: int, episodes: int) -> None:
    """`UsageError`, before anybody drives, for seeds of which no report could tell."""
    if episodes > MOST_DRIVES or first_seed + episodes > MOST_SEED:
        raise UsageError(f"--episodes must be at most {MOST_DRIVES}, and seeds below {MOST_SEED}")


def _check(drives: tuple[Drive, ...]) -> None:
    """`ValueError` for drives that nothing can be computed from."""
    if len({each.seed for each in drives}) < len(drives):
        raise ValueError("a seed stands there twice")
    if not all(abs(each.score) <= LARGEST_FITNESS for each in drives):  # false of NaN too
        raise ValueError(f"a score lies beyond ±{LARGEST_FITNESS:g}")


def _score(found: Evaluated) -> str:
    if found.error is None:
        return f"{found.mean:.1f} on one seed; judged by gymnasium's own environment"
    error = f" ± {found.error:.1f} (standard error)"
    return (
        f"{found.mean:.1f}{error} on {len(found.drives)} seeds, {found.least:.0f} to {found.most:.0f}, "
        f"median {found.median:.0f}, standard deviation {found.std:.1f}; judged by gymnasium's own environment"
    )


def _manner(found: Evaluated) -> str:
    """How it was driven, in a world that tells of it; empty in others."""
    said = []
    if found.finished is not None:
        said += [f"above {mark}: {found.above(mark):.0%}" for mark in MARKS]
        said.append(f"laps finished: {found.finished} of {len(found.drives)}")
    if found.speed is not None:
        said.append(f"mean speed {found.speed:.1f}")
    if found.braking is not None:
        said.append(f"brake on in {found.braking:.0%} of the steps")
    return ", ".join(said)
