"""What hosts without a simulator know of a shipped world is what its task says."""

import pytest

from dreamfleet.common.cli.presets import default_training_preset
from dreamfleet.common.protocol.tasks import DREAM, is_shipped
from dreamfleet.common.worlds.shipped import WORLDS
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.worker.tasks.registry import find_world
from dreamfleet.worker.training.presets import PRESETS


@pytest.mark.parametrize("profile", WORLDS.values(), ids=WORLDS)
def test_a_profile_agrees_with_its_task(profile):
    world = find_world(profile.task).world
    assert is_shipped(profile.task)
    assert world.preset == profile.default_training == default_training_preset(profile.task)
    assert PRESETS[profile.default_training].task == profile.task
    assert profile.demo.word == world.score_word
    assert profile.demo.preset in profile.run_presets


@pytest.mark.parametrize("profile", WORLDS.values(), ids=WORLDS)
def test_a_worlds_presets_are_of_its_dream_or_of_itself(profile):
    for settings in profile.run_presets.values():
        assert settings.get("task", profile.task) in (DREAM, profile.task)
        assert settings.keys() <= RunConfig.__dataclass_fields__.keys()
    for name in profile.training_presets:
        assert PRESETS[name].task == profile.task
