"""The mean score of a controller, where it was measured: of a shipped one by `evaluate`, of others by their run.

Pages: watch.md, own-environment.md.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.function_values import minimises
from dreamfleet.common.runs.seeds import TEST
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.common.worlds.shipped import WORLDS


@dataclass(frozen=True)
class KnownScore:
    """A mean score over `episodes` episodes, its standard error, and the seed of their median, if that is known.

    Of a minimised function the mean is its value.
    """

    mean: float
    error: float | None
    episodes: int
    median_seed: int | None = None

    def describe_beside(self, seed: int, word: str) -> str:
        """What to say beside the score of one seed, so that nobody takes it for the mean; `word`: one seed.

        >>> known = KnownScore(786.1, 50.7, 100, median_seed=10055)
        >>> known.describe_beside(10055, "game")
        ', the median of 100 games, whose mean is 786.1 ± 50.7'
        >>> known.describe_beside(7, "game")
        "; the controller's mean over 100 games: 786.1 ± 50.7"
        """
        mean, episodes = format_with_error(self.mean, self.error), plural(self.episodes, word)
        if seed == self.median_seed:
            return f", the median of {episodes}, whose mean is {mean}"
        return f"; the controller's mean over {episodes}: {mean}"


def median_drive(drives: Mapping[int, float]) -> tuple[int, float]:
    """The seed and score of the middle drive, neither the best nor a crash; of an even number the lower one."""
    return sorted(drives.items(), key=lambda drive: (drive[1], drive[0]))[(len(drives) - 1) // 2]


def first_seed(known: KnownScore | None) -> int:
    """The test seed to show where nobody names one: that of a median episode, if it is known."""
    return TEST.start if known is None or known.median_seed is None else known.median_seed


def find_known_score(controller: Controller) -> KnownScore | None:
    """What is known of a controller's mean score; `None` if nothing is.

    >>> from dreamfleet import find_controller
    >>> find_known_score(find_controller("takecover")).median_seed
    10055
    """
    for each in (score for world in WORLDS.values() for score in world.shipped_scores):
        if controller.sha256.startswith(each.sha256):
            return KnownScore(each.mean, each.error, each.episodes, each.median_seed)
    facts = controller.provenance
    mean, error, episodes = (facts.get(f"validation_{name}") for name in ("mean", "error", "episodes"))
    if (number := _number(mean)) is None or type(episodes) is not int or episodes < 1:
        return None  # a file may say anything
    mean = 0.0 - number if minimises(controller.task, controller.options) else number
    return KnownScore(mean, _number(error), episodes)


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None
