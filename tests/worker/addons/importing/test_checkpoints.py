"""World models and controllers in the exact layout of ctallec/world-models."""

import gymnasium
import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.addons.importing.checkpoints import read_mdnrnn, read_vae
from dreamfleet.worker.training.data.dataset import find_world
from dreamfleet.worker.worldmodel.inference import Decoder, DreamStep
from tests.support import checkpoint_files as theirs


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """Weights, their files, and the bundle and controller made of them."""
    folder, weights = tmp_path_factory.mktemp("exp_dir"), theirs.random_weights()
    theirs.write_checkpoints(folder, weights)
    world, controller = folder / "world.zip", folder / "controller.npz"
    assert main(["import", str(folder), "--out", str(world)]) == 0
    command = ["import", str(folder / "ctrl" / "best.tar"), "--bundle", str(world), "--out", str(controller)]
    assert main(command) == 0
    return folder, weights, Bundle.open(world), Controller.load(controller)


def test_a_controller_acts_as_in_their_program_and_sees_whole_pictures(imported):
    _, weights, bundle, controller = imported
    assert (bundle.manifest.preprocessing, bundle.manifest.picture) == ("whole-64", (64, 64, 3))
    assert controller.variant.actions == "linear"
    pictures = np.random.default_rng(2).integers(0, 256, (20, 64, 64, 3), dtype=np.uint8)
    wanted = theirs.drive(weights, pictures)
    state, actions = None, []
    for each in pictures:
        action, state = controller.predict(each, state, bundle=bundle)
        actions.append(action)
    assert np.abs(np.array(actions) - wanted).max() < 1e-5
    assert np.ptp(wanted, axis=0).min() > 0.1
    assert np.abs(wanted).max() > 1  # beyond what the car does: the LSTM sees it as it is


def test_the_decoder_draws_their_pictures(imported):
    _, (vae, *_), bundle, _ = imported
    latents = np.random.default_rng(3).normal(0, 1, (3, theirs.LATENT)).astype(np.float32)
    wanted = np.stack([theirs.decode(vae, each.astype(float)) for each in latents]) * 255
    found = Decoder(bundle).decode(latents).astype(float)
    assert np.abs(found - wanted).max() <= 1.5  # its weights have half precision, and it rounds
    assert np.ptp(wanted) > 50


def test_a_dream_draws_all_latents_from_one_gaussian(imported):
    _, (_, rnn, _), bundle, _ = imported
    step, random = DreamStep(bundle), np.random.default_rng(4)
    latent = random.normal(0, 1, (40, theirs.LATENT)).astype(np.float32)
    action = random.normal(0, 1, (40, 3)).astype(np.float32)
    uniform, normal = random.random((2, 40, theirs.LATENT), dtype=np.float32)
    found = step.imagine(latent, action, step.zero_state(40), uniform, normal, 1.0)
    chosen = []
    for row in range(40):
        means, spreads, logits, reward, end = theirs.Memory(rnn).advance(
            action[row].astype(float), latent[row].astype(float)
        )
        weights = np.exp(logits - logits.max())
        gaussian = int(np.searchsorted(np.cumsum(weights / weights.sum()), uniform[row, 0], side="right"))
        wanted = means[gaussian] + spreads[gaussian] * normal[row]
        assert np.abs(found.latent[row] - wanted).max() < 5e-3  # heads have half precision
        assert found.reward[row] == pytest.approx(reward, abs=5e-3)
        assert found.done[row] == pytest.approx(theirs.sigmoid(end), abs=5e-3)
        chosen.append(gaussian)
    assert len(set(chosen)) == theirs.MIXTURES


def test_old_and_new_files_of_torch_make_the_same_bundle(imported, tmp_path):
    _, weights, bundle, controller = imported
    theirs.write_checkpoints(tmp_path, weights, legacy=True)
    assert main(["import", str(tmp_path), "--out", str(tmp_path / "world.zip")]) == 0
    assert Bundle.open(tmp_path / "world.zip").sha256 == bundle.sha256
    command = ["import", str(tmp_path / "ctrl"), "--bundle", str(tmp_path / "world.zip"), "--out"]
    assert main([*command, str(tmp_path / "c.npz")]) == 0
    assert Controller.load(tmp_path / "c.npz").sha256 == controller.sha256


def test_a_reward_head_that_was_never_trained_is_left_out(imported, tmp_path):
    _, weights, bundle, _ = imported
    assert bundle.manifest.models["mdnrnn"]["reward"] == "value"
    theirs.write_checkpoints(tmp_path, weights, with_reward=False)
    weights, config = read_mdnrnn(tmp_path / "mdrnn" / "best.tar")
    assert config.reward == "none"
    with_head, _ = read_mdnrnn(imported[0] / "mdrnn" / "best.tar")
    assert np.array_equal(weights["heads.bias"], np.delete(with_head["heads.bias"], -2))


def test_a_part_of_another_shape_is_refused(imported, tmp_path):
    vae, rnn, controller = imported[1]
    bad = {**vae, "encoder.conv2.weight": vae["encoder.conv2.weight"][:, :16]}
    theirs.write_checkpoints(tmp_path, (bad, {**rnn, "rnn.bias_hh_l0": rnn["rnn.bias_hh_l0"] * np.nan}, controller))
    with pytest.raises(DatasetError, match=r"\(64, 16, 4, 4\)"):
        read_vae(tmp_path / "vae" / "best.tar")
    with pytest.raises(DatasetError, match="bias_hh"):
        read_mdnrnn(tmp_path / "mdrnn" / "best.tar")
    with pytest.raises(DatasetError, match="VAE"):
        read_vae(tmp_path / "ctrl" / "best.tar")


@pytest.mark.slow
def test_a_real_drive_is_theirs(imported):
    """Each action in gymnasium's environment is that of their formulas on Pillow's picture of the same observation."""
    image = pytest.importorskip("PIL.Image")
    _, weights, bundle, controller = imported
    environment, seen, actions, state = gymnasium.make("CarRacing-v3"), [], [], None
    observation, _ = environment.reset(seed=5)
    whole = find_world().preprocessings["whole-64"]
    for _ in range(60):
        seen.append(np.asarray(image.fromarray(observation).resize((64, 64), image.Resampling.BILINEAR)))
        action, state = controller.predict(whole.picture(observation), state, bundle=bundle)
        actions.append(action)
        observation, *_ = environment.step(action)
    environment.close()
    assert len({each.tobytes() for each in seen}) > 30
    assert np.abs(np.array(actions) - theirs.drive(weights, seen)).max() < 1e-5
