"""What a bundle says of dreams in its world."""

from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.car_racing_variants import FACTS
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD, DataWorld
from dreamfleet.worker.tasks.api import DreamReward
from dreamfleet.worker.training.dream_facts import NO_DRIVES, RecordedRewards, describe_world, warn_of_unsure_ends
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from tests.support.pixel_world import DodgeTask

ENDS = MDNRNNConfig(reward="none", done=True, done_weight=3.0)
VALUE = MDNRNNConfig(reward="value", done=True, done_weight=3.0)
LABEL = MDNRNNConfig(reward="positive")


def drive(*rewards):
    return np.array(rewards, np.float32)


LIVED = RecordedRewards.of([drive(4, 4, 4, 2), drive(4, 4)], deaths=1)
EARNED = RecordedRewards.of([drive(-0.1, 3.4, -0.1), drive(-0.1, 3.6)])
NOTHING = RecordedRewards.of([drive(0, 0, 0), drive(0, -1)])


class Silent(DodgeTask):
    """A world that says nothing of its reward."""

    world = replace(DodgeTask.world, dream_reward=None)


class Rich(DodgeTask):
    """A world that says what a reward is worth."""

    world = replace(DodgeTask.world, dream_reward=DreamReward(gain=9.0, cost=1.0))


def facts(recorded, layers, task=Silent, **more):
    return describe_world(DataWorld(f"{__name__}:{task.__name__}"), recorded, layers, **more)


def test_what_each_step_gave_is_survival_and_the_last_step_of_a_drive_may_give_less():
    assert RecordedRewards(3.66667, None, 4.0, 1) == LIVED
    assert RecordedRewards.of([drive(0.1, 0.1)]).each_step == 0.1
    assert RecordedRewards.of([drive(-1, -1, 0)]).each_step == -1.0
    for others in ([drive(4, 4, 5)], [drive(4, 4, -1)], [drive(4, 3, 4)], [drive(4, 4), drive(3, 3)], [drive(0, 0, 1)]):
        assert RecordedRewards.of(others).each_step is None
    assert (EARNED.positive, EARNED.other, EARNED.each_step) == (3.5, -0.1, None)
    assert RecordedRewards(None, -0.2, None) == NOTHING


def test_by_default_it_is_survival_where_the_data_are_or_else_what_the_model_predicts():
    assert facts(LIVED, VALUE).reward == RewardFacts("survival", gain=4.0)
    assert facts(LIVED, ENDS).end == EndRule("drawn", odds_weight=3.0)
    assert facts(LIVED, replace(VALUE, done=False, done_weight=1)).reward.source == "value", "no dream would end"
    assert facts(EARNED, VALUE).reward == RewardFacts("value")
    assert facts(EARNED, VALUE).end == EndRule(at=0.5, odds_weight=3.0)
    assert facts(EARNED, ENDS).reward.source == "survival", "nothing else is predicted"
    assert facts(EARNED, LABEL).reward == RewardFacts("label", gain=3.6, cost=0.1)
    assert facts(EARNED, LABEL).end == EndRule()


def test_a_model_without_drives_pays_as_its_world_says(caplog):
    for layers, reward in ((MDNRNNConfig(reward="none"), FACTS.reward), (LABEL, FACTS.reward), (VALUE, RewardFacts())):
        assert describe_world(OF_FIRST_WORLD, NO_DRIVES, layers).reward == reward
    assert not caplog.records


def test_what_is_chosen_is_taken_and_what_the_world_says_is_no_figure_of_the_data():
    both = replace(LABEL, done=True)
    assert facts(EARNED, both, reward="survival", end="0.25").end == EndRule(at=0.25)
    assert facts(LIVED, both, reward="label").reward.source == "label"
    assert facts(LIVED, both, end="drawn", reward="label").end.kind == "drawn"
    assert facts(EARNED, LABEL, Rich).reward == RewardFacts("label", 9.0, 1.0)
    assert facts(LIVED, ENDS, Rich).reward == RewardFacts("survival", 4.0)


@pytest.mark.parametrize(
    ("layers", "chosen"),
    [
        (LABEL, {"reward": "survival"}),
        (LABEL, {"reward": "value"}),
        (VALUE, {"reward": "label"}),
        (ENDS, {"reward": "value"}),
        (MDNRNNConfig(reward="none"), {}),
        (LABEL, {"end": "drawn"}),
        (VALUE, {"end": "1.5"}),
        (VALUE, {"end": "often"}),
    ],
)
def test_what_is_not_predicted_is_refused(layers, chosen):
    with pytest.raises(UsageError):
        facts(EARNED, layers, **chosen)


def test_what_the_data_lack_is_warned_of(caplog):
    facts(EARNED, VALUE)
    facts(RecordedRewards.of([drive(-1, -1, -1)], deaths=1), VALUE)
    assert not caplog.records, "to end sooner is a goal"
    facts(replace(LIVED, deaths=0), VALUE)
    assert facts(NOTHING, LABEL).reward == RewardFacts("label"), "no figure of what it never saw"
    assert len(caplog.records) == 2


def test_a_bar_that_uncertain_ends_may_never_reach_is_warned_of(caplog):
    for rule, quality in ((EndRule(), {"done_auc": 0.99}), (EndRule("drawn"), {"done_auc": 0.7}), (EndRule(), {})):
        warn_of_unsure_ends(rule, quality)
    assert not caplog.records
    warn_of_unsure_ends(EndRule(), {"done_auc": 0.708})
    assert "0.71" in caplog.text
