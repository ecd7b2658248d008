"""The document that `dreamfleet evaluate` writes: a controller's drives, and all that is needed to have them again."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.regular_files import read_text
from dreamfleet.common.protocol.result_bounds import LARGEST_FITNESS
from dreamfleet.common.runs.episode_results import EpisodeResult, EpisodeResults
from dreamfleet.common.serialization.constraints import Length, Seconds
from dreamfleet.common.serialization.optional_fields import OPTIONAL, known
from dreamfleet.common.serialization.validation import MalformedError, from_plain

SCORE_MARKS = (800, 900)  # scores of CarRacing that people ask about
MIN_EPISODES_TO_SOLVE = 100  # drives for a world to be called solved, as gymnasium's threshold has been understood
MAX_BYTES, MAX_EPISODES, MAX_SEED = 64 << 20, 10**5, 2**63
Drives = Annotated[tuple[EpisodeResult, ...], Length(1, MAX_EPISODES)]


@dataclass(frozen=True)
class EvaluationReport:
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
    def results(self) -> EpisodeResults:
        """The drives with their figures."""
        return EpisodeResults(self.drives)

    def to_json(self) -> str:
        """One line: the figures, then the fields, of which the drives are most."""
        return json.dumps({**summary_figures(self.results), **asdict(self)}, allow_nan=False)

    @property
    def description(self) -> str:
        """In words, for people: the score, how it was driven, and what by."""
        lines = (
            _describe_score(self.results),
            _describe_driving(self.results),
            self._describe_threshold,
            self._describe_origin,
        )
        return "\n".join(filter(None, lines))

    @property
    def _describe_threshold(self) -> str:
        """Whether that is gymnasium's mark, or how far from it; empty where the world has none."""
        if self.threshold is None:
            return ""
        beyond, count = self.results.mean - self.threshold, len(self.drives)
        if beyond >= 0 and count >= MIN_EPISODES_TO_SOLVE:
            return f"solved: gymnasium's threshold is a mean of {self.threshold:g}"
        few = "" if count >= MIN_EPISODES_TO_SOLVE else f", on fewer than {MIN_EPISODES_TO_SOLVE} seeds"
        return (
            f"{abs(beyond):.1f} {'above' if beyond >= 0 else 'below'} gymnasium's threshold of {self.threshold:g}{few}"
        )

    @property
    def _describe_origin(self) -> str:
        model = f", world model {self.bundle[:12]}" if self.bundle else ""
        made = f"{self.results.steps:,} environment steps in {self.seconds:.0f} s"
        return f"{made}; controller {self.controller[:12]}{model}; dreamfleet {self.version}"


def summary_figures(results: EpisodeResults) -> dict[str, Any]:
    """What is told of drives together; `error`, `finished`, `speed` and `braking` may be `None`."""
    names = ("mean", "std", "error", "median", "least", "most", "steps", "finished", "speed", "braking")
    found: dict[str, Any] = {"n": len(results.drives), **{name: getattr(results, name) for name in names}}
    found |= {f"above_{mark}": results.above(mark) for mark in SCORE_MARKS}
    return {**found, "scores": results.scores, "seeds": results.seeds}


def read_evaluation_report(path: Path) -> EvaluationReport:
    """What `evaluate --out` wrote; `UsageError` for anything else."""
    try:
        found = from_plain(EvaluationReport, known(EvaluationReport, json.loads(read_text(path, MAX_BYTES))))
        _check_drives(found.drives)
        return found
    except FileNotFoundError:
        raise UsageError(f"no report at {path}: `dreamfleet evaluate --out {path}` writes one") from None
    except (OSError, ValueError, TypeError, MalformedError, RecursionError) as error:
        raise UsageError(f"{path} is no report of `dreamfleet evaluate --out` ({error}): write it again") from error


def check_seed_range(first_seed: int, episodes: int) -> None:
    """`UsageError`, before anybody drives, for seeds of which no report could tell."""
    if episodes > MAX_EPISODES or first_seed + episodes > MAX_SEED:
        raise UsageError(f"--episodes must be at most {MAX_EPISODES}, and seeds below {MAX_SEED}")


def _check_drives(drives: tuple[EpisodeResult, ...]) -> None:
    """`ValueError` for drives that nothing can be computed from."""
    if len({each.seed for each in drives}) < len(drives):
        raise ValueError("a seed stands there twice")
    if not all(abs(each.score) <= LARGEST_FITNESS for each in drives):  # false of NaN too
        raise ValueError(f"a score lies beyond ±{LARGEST_FITNESS:g}")


def _describe_score(found: EpisodeResults) -> str:
    if found.error is None:
        return f"{found.mean:.1f} on one seed; judged by gymnasium's own environment"
    error = f" ± {found.error:.1f} (standard error)"
    return (
        f"{found.mean:.1f}{error} on {len(found.drives)} seeds, {found.least:.0f} to {found.most:.0f}, "
        f"median {found.median:.0f}, standard deviation {found.std:.1f}; judged by gymnasium's own environment"
    )


def _describe_driving(found: EpisodeResults) -> str:
    """How it was driven, in a world that tells of it; empty in others."""
    said = []
    if found.finished is not None:
        said += [f"above {mark}: {found.above(mark):.0%}" for mark in SCORE_MARKS]
        said.append(f"laps finished: {found.finished} of {len(found.drives)}")
    if found.speed is not None:
        said.append(f"mean speed {found.speed:.1f}")
    if found.braking is not None:
        said.append(f"brake on in {found.braking:.0%} of the steps")
    return ", ".join(said)
