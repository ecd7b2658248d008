"""The sources' models: their sizes, and that the export equals the trained model.
Tests config_fields.py, export.py, inference.py, mdnrnn.py, mdnrnn_config.py, mdnrnn_graph.py, vae.py and
vae_config.py."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from dreamfleet.common.artifacts.bundle import POLICY, write_bundle
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.worker.worldmodel import mdnrnn_config as mdnrnn
from dreamfleet.worker.worldmodel import vae_config as vae
from dreamfleet.worker.worldmodel.inference import Decoder, DreamStep, Encoder, PolicyStep, open_part
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN, latent_loss, reward_labels
from dreamfleet.worker.worldmodel.mdnrnn_config import ARTICLE, ATTENTIVE, NOTEBOOK, PAPER, REWARDED, MDNRNNConfig
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
        latent=4, channels=(2, 4, 4, 4, 8), kernels=(5, 3, 4, 4, 1), padding="same", picture=96,
        decoder_kernels=(4, 2, 5, 6, 3), decoder_channels=(4, 3, 3, 2),
    ),
    "from 3x3": VAEConfig(picture=96, decoder_kernels=(5, 5, 6, 6), **TINY),
    "active dense": VAEConfig(activate_dense=True, **TINY),
    "leaky dense": VAEConfig(activate_dense=True, activation="leaky_relu", dense=6, **TINY),
    "everything": VAEConfig(activation="leaky_relu", batch_norm=True, dropout=0.1, **TINY),
    "columns": VAEConfig(latent=32, channels=(4, 8), padding="same", columns=2),
    "everything same": VAEConfig(activation="leaky_relu", batch_norm=True, padding="same", picture=96, **TINY),
}  # fmt: skip


def learnt(module):
    return sum(each.numel() for each in module.parameters() if each.requires_grad)


def test_the_sources_models_have_their_sizes():
    rnn, eyes = MDNRNN(mdnrnn.NOTEBOOK), VAE(vae.NOTEBOOK)
    assert (mdnrnn.NOTEBOOK.lstm_inputs, mdnrnn.NOTEBOOK.hidden, mdnrnn.NOTEBOOK.outputs) == (36, 256, 481)
    assert (learnt(rnn.lstm), learnt(rnn.heads)) == (300_032, 123_617)
    assert [each.kernel for each in vae.NOTEBOOK.up] == [5, 5, 6, 6]
    assert (learnt(eyes), learnt(eyes.decoder) + learnt(eyes.dense)) == (1_062_787, 536_611)
    assert learnt(VAE(vae.PAPER)) == 4_348_547  # ctallec/world-models, the same layers
    assert mdnrnn.PAPER.outputs == 480


def test_what_a_transposed_convolution_crops_lies_behind_as_in_the_notebooks():
    model = Up(ConvolutionLayer(1, 1, 5, 2, 1, 2)).eval()
    with torch.no_grad():
        model.weight.copy_(torch.arange(25.0).reshape(1, 1, 5, 5))
        model.bias.zero_()
        assert torch.equal(model(torch.ones(1, 1, 1, 1))[0, 0], torch.tensor([[6.0, 7.0], [11.0, 12.0]]))


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


def test_the_latents_of_a_column_see_nothing_far_from_it_before_and_after_training():
    model = VAE(VAES["columns"])
    optimiser = torch.optim.Adam(model.parameters(), 0.01)
    for _ in range(2):
        pictures = torch.rand(2, 3, 64, 64)
        changed = pictures.clone()
        changed[..., 40:] = 0
        with torch.no_grad():
            seen, other = (model.encode(each)[0].view(2, 2, 16) for each in (pictures, changed))
            moved = (model.decode(seen.flatten(1)) - model.decode(other.flatten(1))).abs().amax(dim=(0, 1, 2))
        assert torch.equal(seen[..., :8], other[..., :8])
        assert not torch.equal(seen[..., 10:], other[..., 10:])
        assert not moved[:20].any()
        assert moved[40:].all()
        model.loss(pictures, torch.zeros(2, 32)).weighted.backward()
        optimiser.step()


@pytest.mark.parametrize(
    "config",
    [mdnrnn.REWARDED, mdnrnn.NOTEBOOK, mdnrnn.ATTENTIVE, MDNRNNConfig(joint=True), MDNRNNConfig(columns=4, done=True)],
)
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


NO_VAES = [
    {"picture": 32},
    {"channels": ()},
    {"channels": (1,) * 9},
    {"kernels": (4, 4, 4)},
    {"strides": (2, 2, 2, 0)},
    {"decoder_channels": (8, 8, 8, 3)},
    {"decoder_kernels": (5, 5, 6, 7)},
    {"padding": "same", "decoder_kernels": (1, 1, 1, 1)},
    {"dropout": 1.0},
    {"columns": -1},
    {"columns": 2},  # the paper's decoder begins at 1x1
    {"columns": 2, "padding": "same", "latent": 9},
    *({"pixel_weight": weight} for weight in (-1.0, float("nan"))),
]
NO_MDNRNNS = [
    {"hidden": 0},
    {"reward": "none", "previous_reward": True},
    *({name: 3.0} for name in ("first_reward", "done_weight", "done_factor", "reward_scale")),
    {"done": True, "done_weight": 0.0},
    {"reward": "value", "reward_scale": -1.0},
]


@pytest.mark.parametrize("sizes", NO_VAES, ids=str)
def test_sizes_that_make_no_vae_are_refused(sizes):
    with pytest.raises(UsageError):
        VAEConfig(**sizes)


@pytest.mark.parametrize("sizes", NO_MDNRNNS, ids=str)
def test_sizes_that_make_no_mdnrnn_are_refused(sizes):
    with pytest.raises(UsageError):
        MDNRNNConfig(**sizes)


def test_padding_does_not_count():
    torch.manual_seed(0)
    model = MDNRNN(MDNRNNConfig(latent=2, hidden=8))
    inputs, targets, mask = torch.randn(1, 6, 5), torch.randn(1, 6, 2), torch.ones(1, 6)
    mask[:, 4:] = 0
    before = latent_loss(model(inputs), targets, mask)
    targets[:, 4:] = 1e3
    assert torch.equal(latent_loss(model(inputs), targets, mask), before)


@pytest.mark.parametrize("columns", [0, 2])
def test_a_joint_mixture_weighs_whole_gaussians(columns):
    torch.manual_seed(0)
    side = 2 if columns else 1
    model = MDNRNN(MDNRNNConfig(latent=4, hidden=8, mixtures=3, joint=True, columns=columns))
    inputs, targets = torch.randn(2, 5, 7), torch.randn(2, 5, 4)
    predicted = model(inputs)
    assert predicted.log_weights.shape == (2, 5, side, 3)
    likelihood = 0
    for place in range(side):  # a column has every second latent
        means, deviations = (each[..., place::side, :].mT for each in (predicted.means, predicted.log_deviations.exp()))
        gaussians = torch.distributions.Independent(torch.distributions.Normal(means, deviations), 1)
        weights = torch.distributions.Categorical(logits=predicted.log_weights[..., place, :])
        mixture = torch.distributions.MixtureSameFamily(weights, gaussians)
        likelihood += mixture.log_prob(targets[..., place::side])
    wanted = -likelihood.mean() / 4
    assert torch.allclose(latent_loss(predicted, targets, torch.ones(2, 5)), wanted, atol=1e-5)


def test_the_runtime_keeps_no_identifier_and_reports_nothing(tmp_path):
    surroundings = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    words = [sys.executable, "-c", "import dreamfleet.worker.worldmodel.inference, onnxruntime"]
    subprocess.run(words, env={**surroundings, "HOME": str(tmp_path)}, check=True)
    assert not list(tmp_path.rglob("*onnxruntime*"))


def test_a_part_that_is_no_graph_is_an_error_of_the_bundle(random_bundle, tmp_path):
    parts = {name: random_bundle.read(name) for name in random_bundle.manifest.parts}
    broken = write_bundle(tmp_path / "broken.zip", random_bundle.manifest, {**parts, POLICY: b"no graph"})
    with pytest.raises(BundleError, match=r"policy\.onnx"):
        open_part(broken, POLICY)


ROWS = 256
SMALL = {"latent": 4, "hidden": 8, "mixtures": 3, "attention_units": 6}
SMALL_VAE = VAEConfig(latent=4, channels=(4, 4, 8, 8))
VARIANTS = {
    "paper": PAPER,
    "ours": REWARDED,
    "article": ARTICLE,
    "notebook": NOTEBOOK,
    "attentive": ATTENTIVE,
    "done": MDNRNNConfig(done=True, reward="none"),
    "everything": MDNRNNConfig(reward="value", done=True, previous_reward=True, dropout=0.2, window=3),
    "one mixture": MDNRNNConfig(mixtures=1),
    "columns": MDNRNNConfig(columns=2, hidden=64),
    "columns together": MDNRNNConfig(columns=4, hidden=64, joint=True),
    "columns and heads": MDNRNNConfig(columns=2, hidden=70, done=True, previous_reward=True),
    "joint": MDNRNNConfig(joint=True, reward="value", done=True),
    "joint latent": MDNRNNConfig(joint=True, latent=1),
}


def dreamt_in_torch(model, feed, temperature, mask):
    """The same step in torch: softmax, cumulative sum, the first entry beyond `uniform`."""
    config = model.config
    if not config.columns:
        model.heads.weight.data = model.heads.weight.data.half().float()  # as the bundle keeps them
    tensors = {name: torch.from_numpy(each) for name, each in feed.items()}
    with torch.no_grad():
        hidden, state = model.advance(torch.cat([tensors["latent"], tensors["action"]], dim=1), tensors["state"])
        predicted = model.predict(hidden * torch.as_tensor(mask))
    weights = torch.softmax(predicted.log_weights / temperature, dim=-1)
    uniform = tensors["uniform"][:, : config.weighted]
    index = (weights.cumsum(dim=-1) <= uniform[..., None]).sum(dim=-1).clamp(max=config.mixtures - 1)
    index = index.repeat(1, config.latent // config.weighted)
    mean, deviation = (
        each.gather(-1, index[..., None])[..., 0] for each in (predicted.means, predicted.log_deviations)
    )
    latent = mean + deviation.exp() * temperature**0.5 * tensors["normal"]
    reward = predicted.reward if config.reward in ("value", "none") else torch.sigmoid(predicted.reward)
    if config.previous_reward:
        state[:, 2 * config.hidden] = reward if config.reward == "value" else (predicted.reward > 0).float()
    done = torch.sigmoid(predicted.done) if config.done else predicted.done
    return latent.numpy(), state.numpy(), reward.numpy(), done.numpy()


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("temperature", [0.5, 1.15])
def test_the_dream_is_what_torch_dreams(tmp_path, name, temperature):
    config = VARIANTS[name]
    eyes = VAEConfig(latent=config.latent)
    bundle, random = write_random_bundle(tmp_path / "b.zip", vae=eyes, rnn=config), np.random.default_rng(0)
    shapes = {"latent": config.latent, "action": config.actions, "state": config.state}
    feed = {name: random.normal(0, 0.5, (ROWS, size)).astype(np.float32) for name, size in shapes.items()}
    feed["uniform"] = random.random((ROWS, config.latent)).astype(np.float32)
    feed["normal"] = random.normal(size=(ROWS, config.latent)).astype(np.float32)
    mask = np.float32(1)
    if config.dropout:
        mask = (np.random.default_rng(1).random((ROWS, config.hidden)) > config.dropout) / np.float32(0.8)
    dream = DreamStep(bundle).imagine(**feed, temperature=temperature, mask=mask if config.dropout else None)
    expected = dreamt_in_torch(random_models(0, eyes, config)[1], feed, temperature, mask)
    for one, other in zip((dream.latent, dream.state, dream.reward, dream.done), expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)
    assert dream.reward.shape == dream.done.shape == (ROWS,)


@pytest.mark.parametrize(
    ("kind", "scale", "labels"),
    [("positive", 1, [1, 0]), ("notebook", 1, [0, 1]), ("value", 1, [3.2, -0.1]), ("value", 4, [0.8, -0.025])],
)
def test_reality_remembers_its_reward_in_the_heads_form(tmp_path, kind, scale, labels):
    config = MDNRNNConfig(**SMALL, reward=kind, reward_scale=scale, previous_reward=True, window=2)
    policy = PolicyStep(write_random_bundle(tmp_path / "b.zip", rnn=config, vae=SMALL_VAE))
    state = policy.zero_state(2)
    policy.write_rewards(state, np.array([3.2, -0.1]))
    assert np.flatnonzero(state.any(axis=0)).tolist() == [2 * config.hidden]
    np.testing.assert_allclose(state[:, 2 * config.hidden], labels, rtol=1e-6)
