"""From drives to a bundle: each stage by itself, and the pipeline of all of them; a world of one's own.

Tests dreamfleet/experiments/pipeline.py, assemble.py, encode.py, prediction_quality.py, train_mdnrnn.py,
train_vae.py, worker/scoring/rollout.py, worker/training/stages/encode.py, worker/verbs/encode.py and
dreamfleet/experiments/verbs/pipeline.py.
"""

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import RECORDED_STATES, REQUIRED, WEIGHTS, Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.common.cli import command_line
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import ControllerError, DatasetError, DreamfleetError, StoppedError, UsageError
from dreamfleet.experiments import pipeline as stages
from dreamfleet.experiments.pipeline import STAGES, check_vae, parse_flags
from dreamfleet.experiments.verbs import pipeline
from dreamfleet.worker.addons.refit.fit_subspace import find_subspace, make_targets
from dreamfleet.worker.addons.refit.refit import output_bounds, output_names, refit
from dreamfleet.worker.scoring.rollout import DataWorld
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.assemble import assemble, load_quality, record_quality
from dreamfleet.worker.training.checkpoint import load_weights
from dreamfleet.worker.training.data.collect import collect
from dreamfleet.worker.training.data.collect_config import CollectConfig
from dreamfleet.worker.training.data.dataset import episode_paths, load_arrays
from dreamfleet.worker.training.encode import encode
from dreamfleet.worker.training.prediction_quality import area_under_curve
from dreamfleet.worker.training.presets import PRESETS, TrainConfig
from dreamfleet.worker.worldmodel.inference import Encoder, PolicyStep
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle, write_world_bundle
from tests.support.drives import grey, ignore, train_models, write_drive, write_drives
from tests.support.pixel_world import DODGE_TASK, DodgeTask
from tests.support.verbs import find_verb, parse, run_verb

SHORT = TrainConfig(updates=2, batch=8, rate=1e-3)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A data folder that has been through every stage, each two updates long; read only."""
    folder = tmp_path_factory.mktemp("data")
    write_drives(folder, episodes=4, steps=6)
    train_vae.train_vae(folder, SHORT, ignore)
    assert sum(encode(folder)) == 6 + 5 + 4 + 6
    train_mdnrnn.train_mdnrnn(folder, SHORT, ignore)
    return folder


def test_a_bundle_encodes_as_its_training_did_and_is_equal_for_equal_folders(trained, tmp_path):
    bundle, again = (assemble(trained, tmp_path / name, "b", with_weights=True) for name in ("a.zip", "b.zip"))
    assert bundle.sha256 == again.sha256
    assert WEIGHTS in bundle.manifest.parts
    pictures = load_arrays(trained / "episodes" / "000001.npz", "picture")["picture"]
    encoded = load_arrays(trained / "encoded" / "000001.npz", "mu", "mirrored_mu")
    assert np.array_equal(Encoder(bundle).encode(pictures)[0], encoded["mu"])
    mirrored = np.ascontiguousarray(pictures[:, :, ::-1])
    assert np.array_equal(Encoder(bundle).encode(mirrored)[0], encoded["mirrored_mu"])
    assert PolicyStep(bundle).shape == bundle.controller_shape
    assert bundle.controller_shape.size == 867


def test_latents_of_an_older_vae_never_reach_a_bundle(trained, tmp_path):
    folder = shutil.copytree(trained, tmp_path / "data")
    train_vae.train_vae(folder, TrainConfig(3, 8, 1e-3), ignore)
    for _ in range(2):  # before the drives are encoded again, and after that
        for stage in ("mdnrnn", "bundle"):
            with pytest.raises(DatasetError):
                ATTEMPTS[stage](folder)
        list(encode(folder))
    (folder / train_mdnrnn.CHECKPOINT).unlink()
    ATTEMPTS["mdnrnn"](folder)
    ATTEMPTS["bundle"](folder)


ATTEMPTS = {
    "encode": lambda folder: list(encode(folder)),
    "mdnrnn": lambda folder: train_mdnrnn.train_mdnrnn(folder, SHORT, ignore),
    "bundle": lambda folder: assemble(folder, folder / "b.zip", "b", with_weights=False),
}


@pytest.mark.parametrize("stage", ATTEMPTS)
def test_a_stage_before_its_time_names_the_verb_to_run(tmp_path, stage):
    write_drives(tmp_path, episodes=2, steps=4)
    with pytest.raises(DatasetError):
        ATTEMPTS[stage](tmp_path)


@pytest.mark.parametrize("content", [b"", b"no checkpoint", bytes(64)])
def test_a_damaged_checkpoint_is_refused_with_the_remedy(tmp_path, content):
    write_drives(tmp_path, episodes=2, steps=4)
    (tmp_path / train_vae.CHECKPOINT).write_bytes(content)
    with pytest.raises(DatasetError, match="--data"):
        train_vae.train_vae(tmp_path, SHORT, ignore)
    with pytest.raises(DatasetError, match="--data"):
        load_weights(tmp_path / train_vae.CHECKPOINT)


@pytest.mark.parametrize(
    ("scores", "positive", "area"),
    [([1, 2, 3, 4], [0, 0, 1, 1], 1.0), ([4, 3, 2, 1], [0, 0, 1, 1], 0.0), ([1, 2, 3, 4], [1, 0, 0, 1], 0.5)],
)
def test_the_area_under_the_curve(scores, positive, area):
    assert area_under_curve(np.array(scores, np.float32), np.array(positive, bool)) == area


SHARES = {"tiny": 0.004, "notebook": 0.0005, "article": 0.0002, "attentive": 0.001, "paper": 0.00002, "pixels": 0.005}
FEW = ("--jobs", "1", "--collect-flags", "--steps 24", "--vae-flags", "--batch 4", "--yes")


def call(folder, *arguments):
    return run_verb(pipeline, "--data", folder, *arguments)


def made(folder, preset):
    return Bundle.open(folder / f"{preset}.zip")


@pytest.mark.parametrize(
    "name",
    [pytest.param(each, marks={"tiny": (), "pixels": pytest.mark.slow}.get(each, pytest.mark.long)) for each in SHARES],
)
def test_a_share_of_a_preset_becomes_a_bundle_of_its_own_layers(name, tmp_path, capsys):
    assert call(tmp_path, "--preset", name, "--scale", SHARES[name], *FEW, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert tuple(answer["stages"]) == STAGES
    bundle, preset = made(tmp_path, name), PRESETS[name]
    figures = answer["stages"]["train.vae"] | answer["stages"]["train.mdnrnn"]
    assert figures.items() >= bundle.manifest.provenance["quality"].items()
    assert answer["stages"]["bundle"]["sha256"] == bundle.sha256
    assert bundle.manifest.picture[0] == preset.collect.picture
    assert bundle.manifest.hidden == preset.mdnrnn_layers.hidden
    assert bundle.manifest.provenance["episodes"] >= 2
    assert PolicyStep(bundle).zero_state(1).shape == (1, preset.mdnrnn_layers.state)


@pytest.mark.slow
def test_it_goes_on_where_it_stopped_to_the_same_bundle(tmp_path, monkeypatch, capsys):
    flags = ("--preset", "article", "--scale", "0.0001", *FEW)
    assert call(tmp_path / "whole", *flags) == 0
    assert "867" in capsys.readouterr().out

    def stop(_request, _stop):
        raise StoppedError("stopped")

    with monkeypatch.context() as patched:
        patched.setattr(stages, "encode_drives", stop)
        with pytest.raises(StoppedError):
            call(tmp_path / "stopped", *flags)
    assert not (tmp_path / "stopped" / "encoded").exists()
    for _ in range(2):  # and once more, when all is finished
        assert call(tmp_path / "stopped", *flags) == 0
        assert made(tmp_path / "stopped", "article").sha256 == made(tmp_path / "whole", "article").sha256


def test_nothing_is_made_on_a_vae_that_is_no_better_than_the_mean_picture(tmp_path):
    write_drives(tmp_path, episodes=4, steps=6)
    for flags in ((), ("--json",)):
        with pytest.raises(DreamfleetError, match="--yes") as refused:
            call(tmp_path, "--preset", "tiny", "--scale", "0.001", "--jobs", 1, *flags)
        assert type(refused.value) is DreamfleetError
    figures = load_quality(tmp_path)
    assert figures["reconstruction_error"] >= figures["mean_picture_error"]
    assert not (tmp_path / "encoded").exists()
    assert not (tmp_path / train_mdnrnn.CHECKPOINT).exists()
    record_quality(tmp_path, {"reconstruction_error": figures["mean_picture_error"] - 0.01})
    check_vae(tmp_path)


def asked(*arguments):
    return pipeline.make_request(parse(pipeline, "--data", "data", *arguments))


def test_each_stage_has_its_flags_and_the_world_is_of_collecting():
    found = asked(
        "--preset", "pixels", "--collect-flags", "--steps 7", "--vae-flags", "--set latent=5", "--mdnrnn-flags",
        "--set hidden=6 --tensorboard events", "--bundle-flags", "--reward value",
    )  # fmt: skip
    assert (found.collect.settings["steps"], found.vae.settings["latent"]) == (7, 5)
    assert (found.mdnrnn.settings["hidden"], found.mdnrnn.tensorboard) == (6, Path("events"))
    assert (found.bundle.reward, found.bundle.out) == ("value", Path("data/pixels.zip"))
    assert "latent" not in found.mdnrnn.settings
    found = asked("--task", "takecover", "--skip", "1", "--jobs", "2").collect
    assert (found.preset, found.task, found.world, found.jobs) == ("takecover", "takecover", {"skip": 1}, 2)


def test_a_share_of_every_amount_is_rounded_up():
    found = asked("--preset", "notebook", "--scale", "0.02", "--seed", "3")
    assert found.collect.settings == {"episodes": 20, "seed": 3}
    assert found.vae.settings == {"updates": 600, "validate_every": 4, "seed": 3}
    assert found.mdnrnn.settings == {"updates": 200, "validate_every": 4, "seed": 3}
    least = asked("--preset", "tiny", "--scale", "1e-6")
    assert least.collect.settings["episodes"] == 2
    assert least.vae.settings["updates"] == 1


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (("--scale", "0"), "--scale.* 0"),
        (("--scale", "2"), "--scale.* 2"),
        (("--vae-flags", "--dat other"), "--vae-flags.* --data"),
        (("--collect-flags", "'"), "--collect-flags"),
        (("--bundle-flags", "--out b.zip"), "--bundle-flags.* --out"),
        (("--bundle-flags", "--end 7"), "7"),
        (("--preset", "dream"), "'dream'"),
        (("--mdnrnn-flags", "--ghost 1"), "--ghost"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_driven(tmp_path, flags, named):
    with pytest.raises(UsageError, match=named):
        call(tmp_path / "data", *flags)
    assert not (tmp_path / "data").exists()


def test_another_preset_than_the_data_sets_is_refused(tmp_path):
    (tmp_path / "preset.json").write_text('{"preset": "paper", "task": "car-racing"}')
    with pytest.raises(UsageError, match="--preset paper"):
        call(tmp_path)


def test_numbers_beyond_torchs_are_refused():
    with pytest.raises(UsageError, match="8796093022208"):
        replace(SHORT, seed=10**20)
    for config in (VAEConfig, MDNRNNConfig):
        with pytest.raises(UsageError, match=r"16384.*18446744073709551616"):
            config(latent=2**64)


STAGE_FLAGS = {"train vae": ["--updates", "1"], "train mdnrnn": ["--updates", "1"], "bundle": ["--recorded", "0"]}


def hints(capsys):
    """The words of each next command, without the program."""
    found = [line for line in capsys.readouterr().err.splitlines() if line.startswith("next: ")]
    words = [shlex.split(line.removeprefix("next: ")) for line in found]
    return [each[each.index("dreamfleet") + 1 :] if "dreamfleet" in each else each[1:] for each in words]


def check(words):
    """Parse a command, which refuses a wrong flag."""
    parse_flags(*find_verb(words))


def run(words, *more):
    assert command_line.main([*map(str, words), *map(str, more)]) == 0


@pytest.mark.slow
def test_the_stages_of_a_world_model_lead_from_one_to_the_next(tmp_path, capsys):
    write_drives(tmp_path, episodes=4, steps=6)
    words, said = ["collect", "--data", tmp_path, "--episodes", 4, "--jobs", 1, "--preset", "tiny"], []
    while len(said) < 5:
        run(words, *STAGE_FLAGS.get(" ".join(map(str, words[:2])), STAGE_FLAGS.get(words[0], [])))
        words, *others = hints(capsys)
        said.append(words[0] if words[0] != "train" else f"train {words[1]}")
    assert said == ["train vae", "encode", "train mdnrnn", "bundle", "inspect"]
    for each in (words, *others):
        check(each)
    assert [each[0] for each in others] == ["coordinator"]
    assert (tmp_path / "tiny.zip").is_file()

    run(["collect", "--data", tmp_path, "--episodes", 4, "--jobs", 1])
    assert hints(capsys) == [["encode", "--data", str(tmp_path)]], "the VAE is there"
    run(["encode", "--data", tmp_path, "--json"])
    assert not hints(capsys)
    write_drives(tmp_path / "other", episodes=4, steps=6)
    run(["pipeline", "--data", tmp_path / "other", "--preset", "tiny", "--scale", 0.001, "--jobs", 1, "--yes"])
    assert [each[0] for each in hints(capsys)] == ["inspect", "coordinator"], "once, at the end"


@pytest.mark.slow
def test_a_judged_agent_is_recorded_and_the_other_way_round(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(["evaluate", "--controller", "random", "--task", "car-racing", "--episodes", 1, "--jobs", 1])
    (words,) = hints(capsys)
    assert words[:3] == ["record", "--controller", "random"]
    run(words, "--steps", 3)
    assert (tmp_path / "drive.mp4").is_file()
    (words,) = hints(capsys)
    assert words == ["evaluate", "--controller", "random", "--task", "car-racing"]
    check(words)


DRIVES, STATES = 24, 30
BRIEF = TrainConfig(updates=2, batch=4, rate=1e-3, validate_every=1)
EYES = VAEConfig(latent=4, channels=(2, 2, 2, 2))
MEMORY = MDNRNNConfig(latent=4, hidden=6, reward="none", done=True, done_weight=3.0)
CARS = MDNRNNConfig(latent=4, hidden=6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Drives of the test world, and models that learnt from them for two updates."""
    folder = tmp_path_factory.mktemp("dodge")
    config = CollectConfig(episodes=DRIVES, steps=60, anywhere=0.0, patience=0, driver="held")
    assert len(list(collect(folder, config, 1, world=DataWorld(DODGE_TASK)))) == DRIVES
    return train_models(folder, BRIEF, EYES, MEMORY)


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
