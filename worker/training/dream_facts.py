"""What a bundle says of dreams: where their rewards come from, and when they end. Pages: worlds.md, takecover.md."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.world_facts import DRAWN, EndRule, RewardFacts, WorldFacts
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.scoring.rollout import DataWorld
from dreamfleet.worker.tasks.api import World
from dreamfleet.worker.training.data.dataset import find_world, load_steps
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig

log = logging.getLogger(__name__)
Floats = NDArray[np.float32]
Source = Literal["survival", "label", "value"]
SURE = 0.9  # area under the curve below which a warning says that ends are uncertain


@dataclass(frozen=True)
class RecordedRewards:
    """The rewards of recorded drives, and how many of these ended in a death.

    >>> RecordedRewards.of([np.array([4, 4, 1], np.float32), np.array([4, 4], np.float32)]).each_step
    4.0
    """

    positive: float | None  # mean of the rewards above 0; `None`: there is none
    other: float | None  # mean of the others
    each_step: float | None = (
        None  # of every step but a drive's last, which has 0 to this; `None`: they differ, or it is 0
    )
    deaths: int = 0

    @classmethod
    def of(cls, drives: Sequence[Floats], deaths: int = 0) -> RecordedRewards:
        """Of drives with rewards `(T,)`, each of at least one step. Figures have six digits."""
        rewards = np.concatenate(drives).astype(np.float64)
        parts = rewards[rewards > 0], rewards[rewards <= 0]
        positive, other = (_round(part.mean()) if len(part) else None for part in parts)
        before, last = np.concatenate([drive[:-1] for drive in drives]), np.array([drive[-1] for drive in drives])
        step = before[0] if len(before) else last[0]
        shares = last / step if step else np.zeros(0)
        survives = bool(step) and (before == step).all() and (shares >= 0).all() and (shares <= 1).all()
        return cls(positive, other, _round(step) if survives else None, deaths)

    @classmethod
    def load(cls, paths: Sequence[Path]) -> RecordedRewards:
        """Of recorded episodes; `DatasetError` for a damaged one."""
        drives = [load_steps(path) for path in paths]
        return cls.of([drive["reward"] for drive in drives], sum(bool(drive["terminal"]) for drive in drives))


NO_DRIVES = RecordedRewards(None, None, None)  # of an imported model


def describe_world(
    world: DataWorld, recorded: RecordedRewards, layers: MDNRNNConfig, reward: Source | None = None,
    end: str | None = None,
) -> WorldFacts:  # fmt: skip
    """The facts of a data set's world, for a bundle whose MDN-RNN has these `layers`.

    By default the reward is survival where each recorded step has the same one and the MDN-RNN predicts ends. Otherwise
    it is the value or the label that its reward head predicts. Survival ends by chance, other dreams at 0.5.
    `UsageError` for a `reward` or `end` that this MDN-RNN does not predict. A model without a reward head may be of a
    world that says what a label is worth: it serves drives, and no dreams.
    """
    found, source = find_world(*world).world, reward or _default_source(recorded, layers)
    if reward or found.dream_reward is None or found.dream_reward.source != source:
        _check_predicted(source, layers)
    if end is not None and not layers.done:
        raise UsageError(
            "--end is about the ends that a done head predicts: `dreamfleet train mdnrnn --set done=true` adds one"
        )
    default = EndRule(DRAWN) if source == "survival" else EndRule()
    rule = replace(EndRule.parse(end) if end else default, odds_weight=layers.done_weight)
    if recorded != NO_DRIVES:
        _warn_of_gaps(source, recorded)
    return found.facts(_measure_reward(source, recorded, found), rule, world.options)


def warn_of_unsure_ends(rule: EndRule, quality: Mapping[str, float]) -> None:
    """Warn where dreams end above a bar that a model which can hardly foretell ends may never reach."""
    if rule.kind != DRAWN and (area := quality.get("done_auc", 1.0)) < SURE:
        log.warning(
            "this model hardly separates ends from other steps (area under the curve %.2f, 0.5 is chance). Dreams that "
            "end above %g may never end; `bundle --end drawn` ends them as often as they end in the world",
            area,
            rule.at,
        )


def _warn_of_gaps(source: Source, recorded: RecordedRewards) -> None:
    """Warn where the data do not hold what controllers are to be chosen by."""
    if source == "survival" and not recorded.deaths:
        log.warning("no recorded drive ends with a death, so dreams cannot show what leads to one: record longer ones")
    if recorded.positive is None and not (source == "survival" and recorded.each_step):
        log.warning(
            "no recorded reward is above 0: random play never saw one, so dreams cannot show what earns one; record "
            "drives that earn some (`collect --driver`, or `--from-run`)"
        )


def _default_source(recorded: RecordedRewards, layers: MDNRNNConfig) -> Source:
    if layers.done and (recorded.each_step or not layers.has_reward_head):
        return "survival"
    return "value" if layers.reward == "value" else "label"


def _check_predicted(source: Source, layers: MDNRNNConfig) -> None:
    if source == "survival":
        if not layers.done:
            raise UsageError(
                "survival is until the end that a done head predicts: `dreamfleet train mdnrnn --set done=true`"
            )
    elif not layers.has_reward_head or (source == "value") != (layers.reward == "value"):
        raise UsageError(
            f"the {source} of a reward is not what this MDN-RNN predicts, which is {layers.reward!r}: "
            "`dreamfleet train mdnrnn --reward` says what it learns"
        )


def _measure_reward(source: Source, recorded: RecordedRewards, world: World) -> RewardFacts:
    """What one of the source's values is worth: as the world says, or else as recorded."""
    said = world.dream_reward
    if source == "value":
        return RewardFacts()
    if said is not None and said.source == source:
        return RewardFacts(source, said.gain, said.cost)
    if source == "survival":
        return RewardFacts(source, recorded.each_step or 1.0)
    if recorded.positive is None:
        return RewardFacts(source)
    cost = 0.0 - (recorded.other or 0.0)
    return RewardFacts(source, _round(recorded.positive + cost), cost)


def _round(number: float) -> float:
    return float(f"{number:.6g}")
