"""Tests mdnrnn_graph.py."""

import numpy as np
import pytest
import torch

from dreamfleet.worker.worldmodel.inference import DreamStep, PolicyStep
from dreamfleet.worker.worldmodel.mdnrnn_config import ARTICLE, ATTENTIVE, NOTEBOOK, PAPER, REWARDED, MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.models import random_models

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
    "joint": MDNRNNConfig(joint=True, reward="value", done=True),
    "joint latent": MDNRNNConfig(joint=True, latent=1),
}


def chance(config, rows=ROWS, seed=0):
    """The inputs of a step besides the temperature."""
    random = np.random.default_rng(seed)
    shapes = {"latent": config.latent, "action": config.actions, "state": config.state}
    feed = {name: random.normal(0, 0.5, (rows, size)).astype(np.float32) for name, size in shapes.items()}
    feed["uniform"] = random.random((rows, config.latent)).astype(np.float32)
    feed["normal"] = random.normal(size=(rows, config.latent)).astype(np.float32)
    return feed


def dreamt_in_torch(model, feed, temperature, mask):
    """The same step in torch: softmax, cumulative sum, the first entry beyond `uniform`."""
    config = model.config
    model.heads.weight.data = model.heads.weight.data.half().float()  # as the bundle keeps them
    tensors = {name: torch.from_numpy(each) for name, each in feed.items()}
    with torch.no_grad():
        hidden, state = model.advance(torch.cat([tensors["latent"], tensors["action"]], dim=1), tensors["state"])
        predicted = model.predict(hidden * torch.as_tensor(mask))
    weights = torch.softmax(predicted.log_weights / temperature, dim=-1)
    uniform = tensors["uniform"][:, :1] if config.joint else tensors["uniform"]
    index = (weights.cumsum(dim=-1) <= uniform[..., None]).sum(dim=-1).clamp(max=config.mixtures - 1)
    index = index.expand(-1, config.latent)
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
    bundle, feed = write_random_bundle(tmp_path / "b.zip", vae=eyes, rnn=config), chance(config)
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
