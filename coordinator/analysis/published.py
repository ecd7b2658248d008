"""Published scores of worlds, which plots of learning show beside runs."""

from __future__ import annotations

from dataclasses import dataclass


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


# The public log of the CarRacing experiment: the evaluated mean on 1024 tracks. Steps count candidates only. Only the
# total time is known: 1119 hours on 64 cores. Of Take Cover the paper gives scores alone, of a tic a decision.
PUBLISHED: dict[str, PublishedScores] = {
    "car-racing": PublishedScores(
        "Ha & Schmidhuber 2018, their public log (1024 tracks; of its time the end alone is known)",
        (
            PublishedScore(2.6e7, 823),
            PublishedScore(1.0e8, 867),
            PublishedScore(7.8e8, 895),
            PublishedScore(1.7e9, 900.5, 1119 * 64),
        ),
    ),
    "takecover": PublishedScores(
        "Ha & Schmidhuber 2018, from dreams alone: 1092, standard deviation 556 (a decision every tic; their steps are "
        "unknown)",
        (PublishedScore(None, 1092),),
    ),
}
