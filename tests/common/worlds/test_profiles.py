"""What hosts without a simulator know of a shipped world is what its task says."""

from dataclasses import replace

import pytest

from dreamfleet.common.cli.presets import default_training_preset
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import DREAM, is_shipped
from dreamfleet.common.worlds.score_words import score_word_of_run
from dreamfleet.common.worlds.shipped import WORLDS
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.worker.tasks.registry import find_world
from dreamfleet.worker.training.presets import PRESETS
from tests.support.bundles import write_world_bundle
from tests.support.dreams import MODELS, VAE
from tests.support.dreams import WORLDS as DREAMT


@pytest.mark.parametrize("profile", WORLDS.values(), ids=WORLDS)
def test_a_profile_agrees_with_its_task(profile):
    world = find_world(profile.task).world
    assert is_shipped(profile.task)
    assert world.preset == profile.default_training == default_training_preset(profile.task)
    assert PRESETS[profile.default_training].task == profile.task
    assert profile.score_word == world.score_word
    assert profile.demo.preset in profile.run_presets


@pytest.mark.parametrize("profile", WORLDS.values(), ids=WORLDS)
def test_a_worlds_presets_are_of_its_dream_or_of_itself(profile):
    for settings in profile.run_presets.values():
        assert settings.get("task", profile.task) in (DREAM, profile.task)
        assert settings.keys() <= RunConfig.__dataclass_fields__.keys()
    for name in profile.training_presets:
        assert PRESETS[name].task == profile.task


def test_a_run_calls_a_seed_what_its_bundles_world_does(tmp_path, random_bundle):
    facts = replace(DREAMT["choices"], score_word="flight")
    flights = write_world_bundle(tmp_path / "b.zip", facts, "gym:Some-v0", vae=VAE, rnn=MODELS["choices"])
    for bundle, word in ((flights, "flight"), (random_bundle, "track")):
        spec = TaskSpec(DREAM, bundle.sha256, 9, 0)
        assert score_word_of_run(spec, bundle.path) == word
        assert score_word_of_run(spec, tmp_path / "gone.zip") == "seed"
    assert score_word_of_run(TaskSpec("takecover", "", 9, 0), tmp_path / "none.zip") == "game"
