"""Runs in worlds that a bundle describes: nothing of the world is on this host."""

from dataclasses import replace

import pytest

from dreamfleet.common.artifacts.actions import one_hot
from dreamfleet.common.artifacts.bundle_store import shipped_names
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts, WorldFacts
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.messages import OWN_END_VERSION
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.common.worlds import shipped
from dreamfleet.coordinator.service.main import RunRequest, _resolve_settings
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.settings.presets import find_preset
from dreamfleet.experiments.demo import DemoConfig
from tests.support.bundles import write_world_bundle
from tests.support.dreams import ABOUT, DRAWN, MODELS, VAE, WORLDS, write_bundle_of
from tests.support.frozen_settings import comes_back

ABSENT = "a.package.that.is.not.here:Task"


@pytest.fixture
def bundle(tmp_path):
    facts = replace(WORLDS["choices"], packages=("numpy", "onnxruntime", "absent-simulator"), version=3)
    return write_world_bundle(tmp_path / "b.zip", facts, ABSENT, vae=VAE, rnn=MODELS["choices"])


def settings_of(bundle, **flags):
    return freeze(RunConfig(bundle=str(bundle.path), **flags), bundle)


def test_a_run_begins_without_the_worlds_package_and_can_be_configured_again(bundle, tmp_path):
    config = RunConfig(bundle=str(bundle.path), task="dream", variant=("decide_every=4", "feedback=last"))
    request = RunRequest("run", tmp_path, config, LimitsConfig(), NetworkConfig())
    settings, found, *_ = _resolve_settings(request, tmp_path / "run")
    assert found.sha256 == bundle.sha256
    assert settings.packages == ("numpy", "onnxruntime", "absent-simulator")
    assert settings.task.version == 3
    assert settings.task.options == '{"decide_every": 4, "feedback": "last"}'
    assert settings.controller == ControllerShape(3 + 4 + 2 * 3, 3)
    assert comes_back(settings, bundle)


def test_without_a_task_it_is_the_bundles_own_world(bundle, random_bundle):
    assert settings_of(bundle).task.task == ABSENT
    assert settings_of(random_bundle).task.task == "car-racing"
    with pytest.raises(UsageError, match=r"--bundle .*none.*--task"):
        RunConfig(bundle="none")


@pytest.mark.parametrize(("world", "actions"), [("choices", 3), ("one number", 1)])
def test_controllers_have_the_outputs_of_the_world(tmp_path, world, actions):
    bundle = write_bundle_of(world, tmp_path / "b.zip")
    assert settings_of(bundle, task="dream").controller == ControllerShape(7, actions)
    assert settings_of(bundle, task="dream", features="z").controller == ControllerShape(3, actions)


@pytest.mark.parametrize("task", ["takecover", "gym:CartPole-v1"])
def test_a_world_model_of_another_world_is_refused(bundle, random_bundle, task):
    for each, world in ((bundle, ABSENT), (random_bundle, "car-racing")):
        with pytest.raises(UsageError, match=f"{world}.*{task}.*--bundle"):
            settings_of(each, task=task)


def preset_for(preset, bundle):
    changes = {"bundle": str(bundle.path), "subspace": None, "preset": preset}
    return freeze(RunConfig(**find_preset(preset) | changes), bundle)


def test_a_preset_fits_world_models_of_its_world_and_one_without_a_world_model_any(bundle, tmp_path):
    for preset in ("takecover", "real"):
        with pytest.raises(UsageError, match=f"{preset} .*b.zip .*{ABSENT}.*--preset"):
            preset_for(preset, bundle)
    for preset in ("pixels", "dream"):
        assert preset_for(preset, bundle).task.task == "dream"
    own = write_bundle_of("choices", tmp_path / "own.zip", task="takecover")
    assert preset_for("takecover", own).task.horizon == 525, "though it does not ship"


def test_a_gymnasium_environment_is_scored_with_a_world_model_of_its_own(tmp_path):
    bundle = write_bundle_of("choices", tmp_path / "b.zip", task="gym:Some-v0")
    assert settings_of(bundle, task="gym:Some-v0") == settings_of(bundle)


@pytest.mark.parametrize(
    ("flags", "names"),
    [
        ({"variant": ("pedals=one",)}, "pedals.* decide_every, feedback"),
        ({"variant": ("decide_every=0",)}, "decide_every .*50"),
        ({"task": "dream", "end": "soon"}, "'drawn'.*'soon'"),
        ({"task": "dream", "end": "1.5"}, "'drawn'.*1.5"),
        ({"end": "drawn"}, "--end .*dream"),
    ],
)
def test_what_the_world_does_not_have_is_refused(bundle, flags, names):
    with pytest.raises(UsageError, match=names):
        settings_of(bundle, **flags)


def test_an_end_rule_of_the_runs_own_is_another_version(bundle):
    assert bundle.manifest.world.end == DRAWN
    plain, own = settings_of(bundle, task="dream"), settings_of(bundle, task="dream", end="0.250")
    assert (own.task.end, own.task.version, own.task.world_version) == ("0.25", 3 + OWN_END_VERSION, 3)
    assert comes_back(own, bundle)
    assert own.task.digest("score", b"x", (1,)) != plain.task.digest("score", b"x", (1,))
    assert own.task.with_overrides(horizon=20).end == "0.25"
    assert settings_of(bundle, task="dream", end="drawn") == plain, "the bundle's own rule is no rule of the run's own"


def test_a_dream_of_the_first_world_may_have_an_end_too(random_bundle):
    plain = settings_of(random_bundle, task="dream")
    assert plain.task.horizon == 1000
    assert "end" not in to_plain(plain.task)
    assert settings_of(random_bundle, task="dream", end="0.5") == plain
    assert settings_of(random_bundle, task="dream", end="drawn").task.version == 1 + OWN_END_VERSION


@pytest.mark.parametrize("name", ["takecover", "takecover-real", "pixels"])
def test_presets_of_other_worlds_begin_on_their_bundles(tmp_path, name):
    facts = WorldFacts.of(one_hot(3), reward=RewardFacts("survival", gain=4.0), end=EndRule("drawn"), **ABOUT)
    bundle = write_world_bundle(tmp_path / "b.zip", facts, "takecover", vae=VAE, rnn=MODELS["choices"])
    preset = find_preset(name) | {"bundle": str(bundle.path)}
    settings = freeze(RunConfig(**preset), bundle)
    assert comes_back(settings, bundle)


@pytest.mark.parametrize(("limit", "given", "horizon"), [(200, None, 200), (5000, None, 1000), (200, 400, 400)])
def test_episodes_are_no_longer_than_the_bundles_world_unless_a_run_says_so(tmp_path, limit, given, horizon):
    facts = replace(WORLDS["choices"], horizon=limit)
    bundle = write_world_bundle(tmp_path / "b.zip", facts, ABSENT, vae=VAE, rnn=MODELS["choices"])
    preset = find_preset("pixels") | ({"horizon": given} if given else {})
    settings = settings_of(bundle, **preset)
    assert settings.task.horizon == horizon
    assert comes_back(settings, bundle)


def test_each_demonstration_has_a_world_model_that_ships():
    assert {DemoConfig(world=each).plan.bundle for each in shipped.WORLDS} <= set(shipped_names())
    with pytest.raises(UsageError, match=r"--world .*car-racing, takecover.*'moon'"):
        DemoConfig(world="moon")
