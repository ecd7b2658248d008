"""What a world that ships says of itself to every host: its presets, its published scores, its demonstration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


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
    tracks: int = 16  # unseen tracks or games that the outcome is judged on
    # Generations between evaluations, episodes of each, and of the confirmation: in the dream, and in reality.
    dream_evaluations: tuple[int, int, int] = (2, 8, 16)
    real_evaluations: tuple[int, int, int] = (3, 16, 64)
    video_steps: int
    random_score: float | None = None  # of random play
    packages: tuple[str, ...] = ()  # that the world needs beside the demonstration's own


@dataclass(frozen=True, kw_only=True)
class WorldProfile:
    """A world that ships. `task` is its task's name."""

    task: str
    score_word: str = "seed"  # what a scored seed is called: "track", "game"
    # Settings of runs by preset name, as `coordinator` takes them.
    run_presets: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    # Training presets by name: the fields of `TrainingPreset` (worker/training/presets.py) that differ, as mappings.
    training_presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    default_training: str = "pixels"  # the training preset of a new data set
    published: PublishedScores | None = None
    demo: DemoPlan | None = None
