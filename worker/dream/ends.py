"""When dreams end: a bundle's rule at a temperature, and the one place in which it is applied."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.world_facts import DRAWN, EndRule
from dreamfleet.worker.dream.noise import Bars


class DreamEnds:
    """The ends of all dreams of a bundle at one temperature.

    >>> from dreamfleet import find_bundle
    >>> DreamEnds(find_bundle("tiny"), temperature=1.0, text="drawn").rule
    EndRule(kind='drawn', at=0.5, odds_weight=1.0)
    """

    def __init__(self, bundle: Bundle, temperature: float, text: str = "") -> None:
        """`text` is a rule in place of the bundle's, as in `EndRule.parse`; empty: the bundle's own."""
        self.rule = bundle.manifest.facts.end
        if text:
            self.rule = replace(EndRule.parse(text), odds_weight=self.rule.odds_weight)
        self.bars: Bars | None = None  # for the dreams' noise; thresholds need none
        if self.rule.kind == DRAWN:
            self.bars = partial(self.rule.bars, temperature=temperature)

    def are_reached(
        self, predicted: NDArray[np.float32], bar: NDArray[np.float32] | None
    ) -> NDArray[np.bool_]:  # fmt: skip
        """Whether each dream ends `(N,)`, by predicted probabilities `(N,)` and the bars `(N, 1)` of the step's draw.

        Without bars, which every `EpisodeNoise` with drawn ends has, the threshold decides.
        """
        reached: NDArray[np.bool_] = predicted > (np.float32(self.rule.at) if bar is None else bar[:, 0])
        return reached
