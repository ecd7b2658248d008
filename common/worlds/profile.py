"""What every host knows of a world that ships: its presets, published scores, demonstration. Pages: measurements.md."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from dreamfleet.common.printable import format_number, plural

End = Literal["finished", "terminated", "truncated"]
"""How an episode ended: its course was driven to the end, otherwise, or at the limit."""
# What a recording says of it; `{score}` and `{steps}` are the episode's.
ANY_ENDS: Mapping[End, str] = {
    "finished": "the course is finished",
    "terminated": "ended after {counted_steps}",
    "truncated": "the limit of {counted_steps} is reached",
}


@dataclass(frozen=True)
class PublishedScore:
    """A published score; `core_hours` and `steps`, of the environment, are `None` if unknown."""

    steps: float | None
    score: float
    core_hours: float | None = None


@dataclass(frozen=True)
class PublishedScores:
    """The scores of one source in one world, in the order of their steps."""

    source: str
    scores: tuple[PublishedScore, ...]

    @property
    def first_steps(self) -> float:
        """Environment steps of the first score; 0 if they are unknown."""
        return self.scores[0].steps or 0.0


@dataclass(frozen=True, kw_only=True)
class DemoPlan:
    """A demonstration in one world: a run in the dream, and one in reality from the dream's best mean.

    In reality candidates have one episode each until a mean reaches `able_score`, for `quick_steps` at most: far from
    there more generations help more than more episodes, and large steps more than small ones.
    """

    bundle: str  # the world model, a shipped name or a file
    preset: str  # of the run in the dream
    dream_minutes: float
    minutes: float
    temperature: float
    population: int
    episodes: int
    horizon: int
    patience: int
    able_score: float
    quick_steps: int
    variant: str = ""  # of the run in reality: NAME=VALUE, or none
    judge: str  # what the outcome is judged in
    tracks: int = 16  # unseen tracks or games that the outcome is judged on (docs/tutorials/first-drive.md)
    # Generations between evaluations, episodes of each, and of the confirmation: in the dream, and in reality.
    dream_evaluations: tuple[int, int, int] = (2, 8, 16)
    real_evaluations: tuple[int, int, int] = (3, 16, 64)
    video_steps: int
    random_score: float | None = None  # of random play
    packages: tuple[str, ...] = ()  # that the world needs beside the demonstration's own


@dataclass(frozen=True)
class ShippedScore:
    """What `evaluate` measured of a shipped controller, and the seed of its median episode."""

    sha256: str  # of the controller, its first 12 digits
    mean: float
    error: float
    episodes: int
    median_seed: int


@dataclass(frozen=True, kw_only=True)
class WorldProfile:
    """A world that ships, or one of which only its task's name is known.

    >>> WorldProfile(task="gym:CartPole-v1").format_score(21)
    'reward 21.0'
    """

    task: str
    score_word: str = "seed"  # what a scored seed is called: "track", "game"
    score_unit: str = ""  # what a score counts: "points"; empty: it is a sum of rewards
    units_per_second: int = 0  # of a unit that is a time; 0: it is none
    end_texts: Mapping[End, str] = field(default_factory=lambda: ANY_ENDS)
    shipped_scores: tuple[ShippedScore, ...] = ()
    # Settings of runs by preset name, as `coordinator` takes them.
    run_presets: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    dream_preset: str = "pixels"  # of a run in the dream of a new world model
    # Training presets by name: the fields of `TrainingPreset` (worker/training/presets.py) that differ, as mappings.
    training_presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    default_training: str = "pixels"  # the training preset of a new data set
    published: PublishedScores | None = None
    demo: DemoPlan | None = None

    @property
    def score_label(self) -> str:
        """What a score counts, as a label before it."""
        return self.score_unit or "reward"

    def format_amount(self, score: float) -> str:
        """A score's number, and the seconds that it stands for, if its unit is a time."""
        if not self.units_per_second:
            return format_number(score)
        return f"{score:z,.0f} ({score / self.units_per_second:.0f} s)"

    def format_score(self, score: float) -> str:
        """A score with what it counts: 909.4 points, 836 tics survived (24 s), reward 21.0."""
        if not self.score_unit:
            return f"{self.score_label} {self.format_amount(score)}"
        number, *seconds = self.format_amount(score).split(" ", 1)
        return " ".join((number, self.score_unit, *seconds))

    def describe_end(self, end: End, score: float, steps: int) -> str:
        """What a recording says of an episode's end."""
        text = self.end_texts.get(end) or ANY_ENDS[end]
        return text.format(score=score, steps=steps, counted_steps=plural(steps, "step"))
