"""The sources' models: their sizes, and that the export equals the trained model.
Tests config_fields.py, export.py, vae.py and vae_config.py."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from dreamfleet.common.errors import UsageError
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.worker.worldmodel import mdnrnn_config as mdnrnn
from dreamfleet.worker.worldmodel import vae_config as vae
from dreamfleet.worker.worldmodel.inference import Decoder, DreamStep, Encoder, PolicyStep
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN, reward_labels
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae import VAE, Up
from dreamfleet.worker.worldmodel.vae_config import ConvolutionLayer, VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.models import random_models

TINY = {"latent": 4, "channels": (4, 4, 8, 8)}
VAES = {
    "paper": vae.PAPER,
    "notebook": vae.NOTEBOOK,
    "article": vae.ARTICLE,
    "valid 96": VAEConfig(picture=96, **TINY),
    "same 64": VAEConfig(padding="same", **TINY),
    "three layers": VAEConfig(latent=4, channels=(4, 4, 8), kernels=(5, 3, 4), strides=(2, 3, 2)),
    "five same": VAEConfig(
        latent=4,
        channels=(2, 4, 4, 4, 8),
        kernels=(5, 3, 4, 4, 1),
        padding="same",
        picture=96,
        decoder_kernels=(4, 2, 5, 6, 3),
        decoder_channels=(4, 3, 3, 2),
    ),
    "from 3x3": VAEConfig(picture=96, decoder_kernels=(5, 5, 6, 6), **TINY),
    "active dense": VAEConfig(activate_dense=True, **TINY),
    "leaky dense": VAEConfig(activate_dense=True, activation="leaky_relu", dense=6, **TINY),
    "everything": VAEConfig(activation="leaky_relu", batch_norm=True, dropout=0.1, **TINY),
    "everything same": VAEConfig(activation="leaky_relu", batch_norm=True, padding="same", picture=96, **TINY),
}


def learnt(module):
    return sum(each.numel() for each in module.parameters() if each.requires_grad)


def test_the_notebooks_lstm_and_heads_have_its_sizes():
    model = MDNRNN(mdnrnn.NOTEBOOK)
    assert (mdnrnn.NOTEBOOK.lstm_inputs, mdnrnn.NOTEBOOK.hidden, mdnrnn.NOTEBOOK.outputs) == (36, 256, 481)
    assert (learnt(model.lstm), learnt(model.heads)) == (300_032, 123_617)


def test_the_notebooks_vae_has_its_size_and_the_kernels_of_its_decoder():
    model = VAE(vae.NOTEBOOK)
    assert [each.kernel for each in vae.NOTEBOOK.up] == [5, 5, 6, 6]
    assert (learnt(model), learnt(model.decoder) + learnt(model.dense)) == (1_062_787, 536_611)


def test_what_a_transposed_convolution_crops_lies_behind_as_in_the_notebooks():
    model = Up(ConvolutionLayer(1, 1, 5, 2, 1, 2)).eval()
    with torch.no_grad():
        model.weight.copy_(torch.arange(25.0).reshape(1, 1, 5, 5))
        model.bias.zero_()
        assert torch.equal(model(torch.ones(1, 1, 1, 1))[0, 0], torch.tensor([[6.0, 7.0], [11.0, 12.0]]))


def test_plain_and_attentive_compare_at_equal_parameters():
    plain, *others = (
        learnt(MDNRNN(each))
        for each in (mdnrnn.REWARDED, *(replace(mdnrnn.ATTENTIVE, hidden=units) for units in (236, 235, 237)))
    )
    nearest, *further = (abs(count - plain) for count in others)
    assert mdnrnn.ATTENTIVE.hidden == 236
    assert nearest < min(further)
    assert nearest / plain < 0.004


def test_the_papers_vae_and_heads_have_its_sizes():
    assert learnt(VAE(vae.PAPER)) == 4_348_547  # ctallec/world-models, the same layers
    assert mdnrnn.PAPER.outputs == 480


@pytest.mark.parametrize("name", VAES)
def test_an_exported_vae_computes_what_torch_does(tmp_path, name):
    config = VAES[name]
    model, _ = random_models(0, config, MDNRNNConfig(latent=config.latent, hidden=4))
    bundle = write_random_bundle(tmp_path / "b.zip", 0, config, MDNRNNConfig(latent=config.latent, hidden=4))
    pictures = np.random.default_rng(0).integers(0, 256, (3, config.picture, config.picture, 3), dtype=np.uint8)
    with torch.no_grad():
        mu, logvar = model.encode(torch.from_numpy(pictures).permute(0, 3, 1, 2).float() / 255)
        decoded = model.decode(mu).permute(0, 2, 3, 1).numpy() * 255
    for one, other in zip(Encoder(bundle).encode(pictures), (mu, logvar), strict=True):
        np.testing.assert_allclose(one, other.numpy(), atol=1e-4)
    np.testing.assert_allclose(Decoder(bundle).decode(mu.numpy()), decoded, atol=1.0)
    policy = PolicyStep(bundle)
    parameters = np.zeros((3, policy.shape.size), np.float32)
    np.testing.assert_allclose(policy.step(pictures, parameters, policy.zero_state(3)).latent, mu.numpy(), atol=1e-4)


@pytest.mark.parametrize("config", [mdnrnn.REWARDED, mdnrnn.NOTEBOOK, mdnrnn.ATTENTIVE, MDNRNNConfig(joint=True)])
def test_step_by_step_is_the_same_as_a_whole_drive(config):
    torch.manual_seed(0)
    model = MDNRNN(config).eval()
    inputs, state, hidden = torch.randn(2, 6, config.inputs), torch.zeros(2, config.state), []
    with torch.no_grad():
        for step in range(6):
            if config.previous_reward:
                state[:, 2 * config.hidden] = inputs[:, step, -1]
            last, state = model.advance(inputs[:, step, : config.latent + config.actions], state)
            hidden.append(last)
        stepped, whole = model.predict(torch.stack(hidden, dim=1)), model(inputs)
    for one, other in zip(stepped, whole, strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=0)


def test_attention_looks_at_the_past_of_its_own_row():
    torch.manual_seed(0)
    model = MDNRNN(MDNRNNConfig(latent=2, hidden=8, window=3)).eval()
    inputs = torch.randn(2, 8, 5)
    changed = inputs.clone()
    changed[1] += 1  # a neighbour
    changed[0, 7] += 1  # the future
    with torch.no_grad():
        assert torch.equal(model(inputs).means[0, :7], model(changed).means[0, :7])


def test_the_notebooks_label_is_one_where_nothing_is_gained_and_the_episode_goes_on():
    rewards, done = torch.tensor([[3.2, -0.1, -100.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    assert reward_labels("positive", rewards, done).tolist() == [[1, 0, 0]]
    assert reward_labels("notebook", rewards, done).tolist() == [[0, 1, 0]]
    assert reward_labels("value", rewards, done) is rewards
    assert reward_labels("value", rewards, done, 4.0).tolist() == (rewards / 4).tolist()


@pytest.mark.parametrize(
    "make",
    [
        lambda: VAEConfig(picture=32),
        lambda: VAEConfig(channels=()),
        lambda: VAEConfig(channels=(1,) * 9),
        lambda: VAEConfig(kernels=(4, 4, 4)),
        lambda: VAEConfig(strides=(2, 2, 2, 0)),
        lambda: VAEConfig(decoder_channels=(8, 8, 8, 3)),
        lambda: VAEConfig(decoder_kernels=(5, 5, 6, 7)),
        lambda: VAEConfig(padding="same", decoder_kernels=(1, 1, 1, 1)),
        lambda: MDNRNNConfig(first_reward=1.0),
        lambda: VAEConfig(dropout=1.0),
        lambda: MDNRNNConfig(hidden=0),
        lambda: MDNRNNConfig(reward="none", previous_reward=True),
        lambda: MDNRNNConfig(done_weight=3.0),
        lambda: MDNRNNConfig(done_factor=3.0),
        lambda: MDNRNNConfig(done=True, done_weight=0.0),
        lambda: MDNRNNConfig(reward_scale=2.0),
        lambda: MDNRNNConfig(reward="value", reward_scale=-1.0),
        lambda: VAEConfig(pixel_weight=-1.0),
        lambda: VAEConfig(pixel_weight=float("nan")),
    ],
)
def test_sizes_that_make_no_model_are_refused(make):
    with pytest.raises(UsageError):
        make()


def test_a_model_of_the_paper_is_written_as_it_was_before_every_layer_had_a_flag():
    later = {"error_factor", "kernels", "strides", "decoder_channels", "decoder_kernels", "pixel_weight"}
    later |= {"activate_dense"}
    assert set(to_plain(vae.PAPER)) == set(asdict(vae.PAPER)) - later
    assert not {"lost", "first_reward", "done_factor", "done_weight", "reward_scale"} & set(to_plain(mdnrnn.REWARDED))


def test_the_first_step_sees_the_label_that_the_notebooks_drives_begin_with(tmp_path):
    bundle = write_random_bundle(tmp_path / "b.zip", 0, vae.NOTEBOOK, mdnrnn.NOTEBOOK)
    for step in (PolicyStep(bundle), DreamStep(bundle)):
        state = step.zero_state(2)
        assert state[:, 2 * mdnrnn.NOTEBOOK.hidden].tolist() == [1, 1]
        assert state.sum() == 2
