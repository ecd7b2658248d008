"""The report that `dreamfleet evaluate` writes: a controller's episodes, and all that is needed to repeat them.

Pages: own-environment.md, own-world-model.md.
"""

import json
from collections.abc import Mapping, Sized
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from math import isclose
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, Literal

from msgspec import Meta

from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.regular_files import read_text
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.printable import format_number, one_line, plural, truncate
from dreamfleet.common.protocol.function_values import minimises
from dreamfleet.common.protocol.result_bounds import LARGEST_FITNESS
from dreamfleet.common.runs.episode_results import EpisodeResult, EpisodeResults, FailedEpisode
from dreamfleet.common.runs.paired_difference import is_clearly_below
from dreamfleet.common.runs.standard_error import format_with_error, score_digits, standard_error
from dreamfleet.common.schema.validation import OPTIONAL, MalformedError, Seconds, from_plain_lenient

REPORT = "evaluation.json"  # its name in a run's folder and in a card's
GYMNASIUM = "gymnasium"  # the judge of worlds that gymnasium itself has
FACTS = "controller", "task", "options", "world", "judge", "bundle", "threshold", "marks"  # what was driven
MAX_MARKS, MAX_FIGURES = 8, 64
MIN_EPISODES_TO_SOLVE = 100  # customary number of episodes for gymnasium's threshold of solving an environment
MAX_BYTES, MAX_EPISODES, MAX_SEED = 64 << 20, 10**5, 2**63
Sight = Literal["hidden", "foreign"]
SIGHTS: dict[Sight, str] = {"hidden": "blind", "foreign": "with another's sight"}  # fields, and what they are called
FAILED = "_failed"  # after such a name: the field of its episodes without a score
BLIND_FIGURES = "n", "mean", "mean_error", "loss", "loss_error"
ABOVE = "above_"  # and a mark: the share of scores above it
Drives = Annotated[tuple[EpisodeResult, ...], Meta(min_length=1, max_length=MAX_EPISODES)]
BlindDrives = Annotated[tuple[EpisodeResult, ...], Meta(max_length=MAX_EPISODES)]
Failures = Annotated[tuple[FailedEpisode, ...], Meta(max_length=MAX_EPISODES)]


@dataclass(frozen=True)
class EvaluationReport:
    """A controller, its environment and host, and its results, one episode a seed."""

    name: str  # of the controller on the command line
    controller: str  # SHA-256 of its parameters
    task: str  # that the controller was evolved in
    world: str  # the task that it was evaluated in; another one if it was evolved in a dream
    bundle: str  # SHA-256; empty: none
    fingerprint: str  # of the evaluating host
    version: str  # of dreamfleet
    seconds: Seconds
    drives: Drives
    judge: str = GYMNASIUM  # or the world whose environment judged
    #: mean score from which the environment counts as solved; `None` if none is named
    threshold: float | None = field(default=None, metadata=OPTIONAL)
    #: episodes without a score; every statistic leaves them out
    failed: Failures = field(default=(), metadata=OPTIONAL)
    #: scores of which the share of episodes above them is reported
    marks: Annotated[tuple[float, ...], Meta(max_length=MAX_MARKS)] = field(default=(), metadata=OPTIONAL)
    #: of `task`, as a run freezes them
    options: str = field(default="", metadata=OPTIONAL)
    #: the same seeds, with what decides painted out of its pictures; empty: not driven
    hidden: BlindDrives = field(default=(), metadata=OPTIONAL)
    hidden_failed: Failures = field(default=(), metadata=OPTIONAL)
    #: the same, with what decides another episode in its place
    foreign: BlindDrives = field(default=(), metadata=OPTIONAL)
    foreign_failed: Failures = field(default=(), metadata=OPTIONAL)
    #: how much less its mean was to be in each blind pass, at least; `None`: nothing was asked
    asked_loss: Annotated[float, Meta(ge=0, le=LARGEST_FITNESS)] | None = field(default=None, metadata=OPTIONAL)

    @cached_property
    def results(self) -> EpisodeResults:
        """The episodes with their statistics."""
        return EpisodeResults(self.drives, self.failed, minimises(self.task, self.options))

    @property
    def blind_passes(self) -> "dict[Sight, EvaluationReport]":
        """What was driven blind, by the name of its field, each as a report of its own; perhaps without any score."""
        driven = {sight: (getattr(self, sight), getattr(self, sight + FAILED)) for sight in SIGHTS}
        no_sight: dict[str, Any] = {name: () for sight in SIGHTS for name in (sight, sight + FAILED)}
        no_sight["asked_loss"] = None
        return {
            sight: replace(self, name=f"{self.name}, {SIGHTS[sight]}", drives=drives, failed=failed, **no_sight)
            for sight, (drives, failed) in driven.items()
            if drives or failed
        }

    def to_json(self) -> str:
        """One line of JSON: the statistics, then all fields; a statistic that is unknown is null."""
        return json.dumps({**self.figures, **asdict(self)}, allow_nan=False)

    @property
    def facts(self) -> dict[str, object]:
        """What was driven, by the names of the fields."""
        return {name: getattr(self, name) for name in FACTS}

    @property
    def figures(self) -> dict[str, object]:
        """The statistics by their names in JSON."""
        results = self.results
        return {
            "n": len(results.drives), "mean": results.mean, "std": results.std, "error": results.error,
            "median": results.median, "least": results.worst, "most": results.best, "steps": results.steps,
            "finished": results.finished, "speed": results.speed, "braking": results.braking,
            **{f"{ABOVE}{mark:g}": results.above(mark) for mark in self.marks},
            "scores": results.scores, "seeds": results.seeds, "figures": self.world_figures,
            **{f"{sight}_{key}": value for sight in SIGHTS for key, value in self._blind_figures(sight).items()},
            "asked_loss": self.asked_loss, "sees": None if self.asked_loss is None else self.sees,
        }  # fmt: skip

    @property
    def world_figures(self) -> dict[str, float]:
        """The means of what the world says of its episodes, over those of which it says it."""
        found = [each.figures or {} for each in self.drives]
        names = sorted({name for each in found for name in each})
        return {name: fmean(each[name] for each in found if name in each) for name in names}

    @property
    def sees(self) -> bool:
        """Whether the loss in each blind pass is as much as was asked, and significant."""
        return not self._passes_without_loss()

    def _passes_without_loss(self) -> list[str]:
        """The blind passes that do not show the loss that was asked for, in words; also those without a score."""
        missing, asked = [], self.asked_loss or 0.0
        for sight, text in SIGHTS.items():
            plain, blind = self._paired_scores(sight)
            if not is_clearly_below(blind, plain) or fmean(plain.values()) - fmean(blind.values()) < asked:
                missing.append(text)
        return missing

    def _paired_scores(self, sight: Sight) -> tuple[dict[int, float], dict[int, float]]:
        """The scores with sight and those of this pass, by seed.

        They are over the seeds with a score in each pass that has any, so that all passes have the same episodes.
        """
        passes = [{each.seed for each in found.drives} for found in self.blind_passes.values() if found.drives]
        plain = {each.seed: each.score for each in self.drives}
        blind = {each.seed: each.score for each in getattr(self, sight)}
        seeds = [seed for seed in plain if blind and all(seed in each for each in passes)]
        return {seed: plain[seed] for seed in seeds}, {seed: blind[seed] for seed in seeds}

    def _blind_figures(self, sight: Sight) -> dict[str, float | None]:
        """The mean over the `n` seeds of what was driven blind, and how much less it is than with sight, by seed."""
        plain, blind = self._paired_scores(sight)
        if not plain:
            return dict.fromkeys(BLIND_FIGURES)
        means, less = [*blind.values()], [plain[seed] - score for seed, score in blind.items()]
        values = len(plain), fmean(means), standard_error(means), fmean(less), standard_error(less)
        return dict(zip(BLIND_FIGURES, values, strict=True))

    def describe_scores(self, word: str = "seed") -> list[str]:
        """The score in words, then the blind ones if they were driven."""
        lines, passes = [self._describe_score(word)], self.blind_passes
        for sight, text in SIGHTS.items() if passes else ():
            found, parts = self._blind_figures(sight), [passes[sight].results.failure_text] if sight in passes else []
            if found["n"]:
                score, loss = (format_with_error(found[key] or 0.0, found[f"{key}_error"]) for key in ("mean", "loss"))
                parts.insert(0, f"{score} on {plural(int(found['n']), word)}, {loss} less, {word} by {word}")
            lines.append(f"{text}: {'; '.join(filter(None, parts)) or 'no score'}")
        return [*lines, *([] if self.asked_loss is None else [self.describe_sight()])]

    def describe_sight(self) -> str:
        """Whether it loses as much without sight as was asked, in words."""
        loss = f"significant loss of at least {format_number(self.asked_loss or 0.0)}"
        if missing := self._passes_without_loss():
            return f"not shown to see: no {loss} {' and '.join(missing)}"
        return f"it sees: a {loss} {' and '.join(SIGHTS.values())}"

    def describe(self, word: str = "seed") -> str:
        """A text for display: the score, figures on driving, the threshold and the controller; `word`: one seed."""
        failures = self.results.failure_text
        above = [f"above {mark:g}: {self.results.above(mark):.0%}" for mark in self.marks]
        of_world = [f"{one_line(name).replace('_', ' ')}: {mean:.3g}" for name, mean in self.world_figures.items()]
        score, *blind = self.describe_scores(word)
        lines = (
            failures and f"{failures}; all figures are over the episodes with a score",
            score,
            ", ".join([*above, *_describe_driving(self.results), *of_world]),
            *blind,
            self._describe_threshold(word),
            self._describe_origin(),
        )
        return "\n".join(filter(None, lines))

    def _describe_threshold(self, word: str) -> str:
        """Whether the threshold is reached, or the distance to it; empty if there is none."""
        if self.threshold is None:
            return ""
        named = "gymnasium's threshold" if self.judge == GYMNASIUM else "the world's threshold"
        beyond, count = self.results.mean - self.threshold, len(self.drives)
        if beyond >= 0 and count >= MIN_EPISODES_TO_SOLVE and self.failed:
            return f"{format_number(beyond)} above {named} of {self.threshold:g} without the failed episodes"
        if beyond >= 0 and count >= MIN_EPISODES_TO_SOLVE:
            return f"solved: {named} is a mean of {self.threshold:g}"
        few = "" if count >= MIN_EPISODES_TO_SOLVE else f", on fewer than {MIN_EPISODES_TO_SOLVE} {word}s"
        return f"{format_number(abs(beyond))} {'above' if beyond >= 0 else 'below'} {named} of {self.threshold:g}{few}"

    def _describe_score(self, word: str) -> str:
        found = self.results
        score = format_with_error(found.shown(found.mean), found.error)
        judged = "in gymnasium's environment" if self.judge == GYMNASIUM else f"in {one_line(self.judge)}"
        if found.std is None:
            return f"{score} on one {word}; judged {judged}"
        digits = score_digits(found.mean, found.error)
        figures = (*map(found.shown, (found.worst, found.best, found.median)), found.std)
        worst, best, median, std = (format_with_error(each, None, digits) for each in figures)
        return (
            f"{score} (standard error) on {len(found.drives)} {word}s, {worst} to {best}, median {median}, standard "
            f"deviation {std}; judged {judged}"
        )

    def _describe_origin(self) -> str:
        model = f", world model {self.bundle[:12]}" if self.bundle else ""
        made = f"{self.results.steps:,} environment steps in {self.seconds:.0f} s"
        return f"{made}; controller {self.controller[:12]}{model}; dreamfleet {one_line(self.version)}"


def contradicts(recorded: object, now: object) -> bool:
    """Whether a figure or fact of a record is another one now; it states nothing where it is empty."""
    return recorded not in (None, "", ()) and recorded != now


def differing_facts(recorded: EvaluationReport, now: Mapping[str, object]) -> tuple[str, ...]:
    """The facts that the record states, and that are others now."""
    return tuple(name for name, was in recorded.facts.items() if contradicts(was, now[name]))


def read_evaluation_report(path: Path) -> EvaluationReport:
    """Read a file that `evaluate --out` wrote; `UsageError` for anything else, also for statistics of other drives."""
    try:
        plain = json.loads(read_text(path, MAX_BYTES))
        found = from_plain_lenient(EvaluationReport, plain)
        if not isinstance(json.loads(found.options or "{}"), dict):
            raise ValueError("its options are not a JSON object")
        own = _check_episodes(found)
        for name, blind in found.blind_passes.items():
            if not _check_episodes(blind) <= own:
                raise ValueError(f"{name} has a seed that was not driven with sight")
        _check_figures(found, plain)
        found.to_json()  # `ValueError` for a number that is not finite
        return found
    except FileNotFoundError:
        raise UsageError(f"no report at {path}: `{shell_command('evaluate', '--out', path)}` writes one") from None
    except (OSError, ValueError, TypeError, MalformedError, RecursionError, OverflowError, UsageError) as error:
        raise UsageError(f"{path} is not a report of `dreamfleet evaluate --out` ({error}): write it again") from error


def _check_episodes(report: EvaluationReport) -> set[int]:
    """The seeds of a report's episodes; `ValueError` for one twice, a score out of range, or too many names."""
    seeds = [*(each.seed for each in report.drives), *(each.seed for each in report.failed)]
    if len(set(seeds)) < len(seeds):
        raise ValueError("a seed occurs twice")
    if not all(abs(each.score) <= LARGEST_FITNESS for each in report.drives):  # false for NaN too
        raise ValueError(f"a score is beyond ±{LARGEST_FITNESS:g}")
    check_names({name for each in report.drives for name in each.figures or ()})
    return set(seeds)


def _check_figures(report: EvaluationReport, plain: Mapping[str, object]) -> None:
    """`ValueError` for a statistic that the drives contradict; a report need not state each."""
    marks = {name: float(name.removeprefix(ABOVE)) for name in plain if name.startswith(ABOVE)}
    check_names(marks=marks)
    figures = {name: report.results.above(mark) for name, mark in marks.items()} | report.figures
    for name, value in figures.items():
        stated = plain.get(name)
        if stated is not None and not _is_equal(stated, value):
            raise ValueError(f"{name} is {truncate(str(stated), 40)}, and of its drives it is {value}")


def _is_equal(stated: object, value: object) -> bool:
    """Whether a figure is that one, up to the last bits of a mean; of scores and seeds, every bit."""
    if isinstance(value, tuple):
        return stated == list(value)
    if isinstance(value, dict):
        if not isinstance(stated, dict) or not stated.keys() <= value.keys():
            return False
        return all(_is_equal(each, value[name]) for name, each in stated.items())
    return isinstance(stated, int | float) and isinstance(value, int | float) and isclose(stated, value)


def check_names(figures: Sized = (), marks: Sized = ()) -> None:
    """`UsageError` for more figures or marks of a world than a report holds."""
    for found, most, what in ((figures, MAX_FIGURES, "figures"), (marks, MAX_MARKS, "marks")):
        if len(found) > most:
            raise UsageError(f"its world has {len(found):,} {what}, and a report holds at most {most}")


def check_seed_range(first_seed: int, episodes: int) -> None:
    """`UsageError` for seeds that no report can hold; call it before the episodes run."""
    if episodes > MAX_EPISODES or first_seed + episodes > MAX_SEED:
        raise UsageError(f"--episodes must be at most {MAX_EPISODES}, and seeds below {MAX_SEED}")


def _describe_driving(found: EpisodeResults) -> list[str]:
    parts = []
    if found.finished is not None:
        parts.append(f"laps finished: {found.finished} of {len(found.drives)}")
    if found.speed is not None:
        parts.append(f"mean speed {found.speed:.1f}")
    if found.braking is not None:
        parts.append(f"brake on in {found.braking:.0%} of the steps")
    return parts
