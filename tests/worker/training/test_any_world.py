"""A world with what docs/reference/worlds.md requires, from drives to a world model in which candidates evolve.
Tests worker/scoring/rollout.py."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import RECORDED_STATES, REQUIRED, Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import ControllerError, DatasetError, UsageError
from dreamfleet.worker.addons.refit.fit_subspace import find_subspace, make_targets
from dreamfleet.worker.addons.refit.refit import output_bounds, output_names, refit
from dreamfleet.worker.scoring.rollout import DataWorld
from dreamfleet.worker.training import train_vae
from dreamfleet.worker.training.assemble import assemble
from dreamfleet.worker.training.data.collect import collect
from dreamfleet.worker.training.data.collect_config import CollectConfig
from dreamfleet.worker.training.data.dataset import episode_paths, load_arrays
from dreamfleet.worker.training.encode import encode
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle, write_world_bundle
from tests.support.drives import grey, ignore, train_models, write_drive
from tests.support.pixel_world import DODGE_TASK, DodgeTask

DRIVES, STATES = 24, 30
FEW = TrainConfig(updates=2, batch=4, rate=1e-3, validate_every=1)
EYES = VAEConfig(latent=4, channels=(2, 2, 2, 2))
MEMORY = MDNRNNConfig(latent=4, hidden=6, reward="none", done=True, done_weight=3.0)
CARS = MDNRNNConfig(latent=4, hidden=6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Drives of the test world, and models that learnt from them for two updates."""
    folder = tmp_path_factory.mktemp("dodge")
    config = CollectConfig(episodes=DRIVES, steps=60, anywhere=0.0, patience=0, driver="held")
    assert len(list(collect(folder, config, 1, world=DataWorld(DODGE_TASK)))) == DRIVES
    return train_models(folder, FEW, EYES, MEMORY)


@pytest.fixture(scope="module")
def bundle(folder):
    return assemble(folder, folder / "dodge.zip", "dodge", with_weights=False, recorded=STATES)


def rewards(folder):
    return [load_arrays(path, "reward")["reward"] for path in episode_paths(folder)]


def deaths(folder):
    """The lengths of the drives that ended with a death."""
    ended = [load_arrays(path, "ended")["ended"] for path in episode_paths(folder)]
    return [len(reward) for reward, died in zip(rewards(folder), ended, strict=True) if died]


def test_the_bundle_describes_its_world_and_holds_no_graph_with_a_controller(folder, bundle):
    manifest = bundle.manifest
    assert (manifest.task, manifest.preprocessing, manifest.actions) == (DODGE_TASK, "box-64", 3)
    assert manifest.world == DodgeTask.world.facts(RewardFacts("survival", 1.0), EndRule("drawn", odds_weight=3.0))
    assert set(manifest.parts) == {*REQUIRED, RECORDED_STATES}
    provenance = manifest.provenance
    assert (provenance["drivers"], provenance["deaths"]) == ({"held": DRIVES}, len(deaths(folder)))
    assert set(provenance["versions"]) == {"dreamfleet", "torch", *DodgeTask.world.packages}
    again = assemble(folder, folder / "again.zip", "dodge", with_weights=False, recorded=STATES)
    assert again.sha256 == bundle.sha256


def test_encoded_drives_say_what_the_drives_say_and_are_mirrored_where_the_world_is(folder):
    for drive, latents in zip(episode_paths(folder), episode_paths(folder, "encoded"), strict=True):
        for name in ("world", "action", "reward", "ended"):
            assert np.array_equal(load_arrays(drive, name)[name], load_arrays(latents, name)[name])
        assert "mirrored_mu" in load_arrays(latents, "mirrored_mu")


class Unmirrored(DodgeTask):
    """The same world, in which a mirrored picture shows nothing."""

    world = replace(DodgeTask.world, mirror=None)


def write_made_up_drive(folder, number, task=DODGE_TASK, steps=120):
    """A drive whose action follows from how bright the picture is, cut by a limit."""
    wave = np.sin(np.arange(steps) / 15 + number)
    return write_drive(
        folder, number, steps, world=DataWorld(task), pictures=grey(127 + 100 * wave), ended=np.array(True),
        terminal=np.array(False), action=np.eye(3, dtype=np.float32)[np.digitize(wave, (-0.3, 0.3))],
    )  # fmt: skip


def test_what_some_drives_alone_say_is_copied_and_without_a_mirror_no_picture_is_mirrored(folder, tmp_path):
    shutil.copy(folder / train_vae.CHECKPOINT, tmp_path)
    for number in range(2):
        write_made_up_drive(tmp_path, number, f"{__name__}:Unmirrored")
    assert len(list(encode(tmp_path))) == 2
    with np.load(tmp_path / "encoded" / "000000.npz") as latents:
        assert (bool(latents["ended"]), bool(latents["terminal"])) == (True, False)
        assert str(latents["world"]) == f"{__name__}:Unmirrored\n"
        assert "mirrored_mu" not in latents


def test_up_to_half_of_the_recorded_states_lie_before_deaths(folder, bundle):
    late = sum(length >= 26 for length in deaths(folder))
    assert bundle.recorded_count == STATES
    assert bundle.manifest.provenance["recorded"] == {"states": STATES, "before_losses": min(late, STATES // 2)}


@pytest.mark.parametrize("hidden", [0, 5])
def test_a_controller_is_fitted_to_another_model_of_the_world(folder, bundle, tmp_path, hidden):
    other = write_world_bundle(tmp_path / "other.zip", bundle.manifest.world, seed=1, vae=EYES, rnn=MEMORY)
    shape = bundle.shape_of("zh", hidden)
    drawn = np.random.default_rng(3).normal(size=shape.size).astype(np.float32)
    before = Controller(shape, drawn, DODGE_TASK, bundle.sha256)
    assert np.isinf(output_bounds(before, bundle)).all() == (not hidden), "choices are compared, wherever they lie"
    assert output_names(before, bundle)[0] == ("output 1" if hidden else "stay")
    found = refit(before, bundle, other, episode_paths(folder), ignore)
    assert (found.controller.bundle, found.controller.shape) == (other.sha256, shape)
    assert found.steps == sum(map(len, rewards(folder))), "no step is off the course"
    held = refit(replace(before, options='{"decide_every": 4}'), bundle, other, episode_paths(folder), ignore)
    assert np.array_equal(held.controller.parameters, found.controller.parameters)
    with pytest.raises(DatasetError, match="car-racing"):
        refit(before, bundle, other, [write_drive(tmp_path / "others", 0)], ignore)
    with pytest.raises(ControllerError):
        refit(before, bundle, write_random_bundle(tmp_path / "cars.zip", vae=EYES, rnn=CARS), [], ignore)


def test_features_of_it_predict_actions_that_are_chosen(folder, bundle, tmp_path):
    names = [each.name for each in make_targets(DodgeTask.world, 3)]
    assert names[:3] == ["stay 0-5", "left 0-5", "right 0-5"], "one window each: none goes both ways"
    with pytest.raises(UsageError):
        find_subspace(bundle, episode_paths(folder), ignore)
    found = find_subspace(bundle, [write_made_up_drive(tmp_path, number) for number in range(15)], ignore)
    assert {"stay 0-5", "right 0-5"} <= set(found.subspace.names)
    assert not [name for name in found.subspace.names if name.startswith("|")], "a choice has no sign"


def test_the_verb_takes_another_reward_and_end_of_any_world(folder, tmp_path, capsys):
    out = tmp_path / "b.zip"
    command = ["bundle", "--data", str(folder), "--out", str(out), "--json"]
    assert main([*command, "--end", "0.25"]) == 0
    printed = json.loads(capsys.readouterr().out)
    made = Bundle.open(out)
    assert (printed["sha256"], made.manifest.world.end) == (made.sha256, EndRule(at=0.25, odds_weight=3.0))
    assert main([*command, "--reward", "value"]) == 2
    assert "--reward" in capsys.readouterr().err
