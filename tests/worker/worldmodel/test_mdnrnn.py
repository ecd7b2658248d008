"""Tests mdnrnn.py and mdnrnn_config.py."""

import torch

from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN, latent_loss
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig


def test_padding_does_not_count():
    torch.manual_seed(0)
    model = MDNRNN(MDNRNNConfig(latent=2, hidden=8))
    inputs, targets, mask = torch.randn(1, 6, 5), torch.randn(1, 6, 2), torch.ones(1, 6)
    mask[:, 4:] = 0
    before = latent_loss(model(inputs), targets, mask)
    targets[:, 4:] = 1e3
    assert torch.equal(latent_loss(model(inputs), targets, mask), before)


def test_a_joint_mixture_weighs_whole_gaussians():
    torch.manual_seed(0)
    model = MDNRNN(MDNRNNConfig(latent=4, hidden=8, mixtures=3, joint=True))
    inputs, targets = torch.randn(2, 5, 7), torch.randn(2, 5, 4)
    predicted = model(inputs)
    assert predicted.log_weights.shape == (2, 5, 1, 3)
    gaussians = torch.distributions.Independent(
        torch.distributions.Normal(predicted.means.mT, predicted.log_deviations.mT.exp()), 1
    )
    weights = torch.distributions.Categorical(logits=predicted.log_weights[..., 0, :])
    mixture = torch.distributions.MixtureSameFamily(weights, gaussians)
    wanted = -mixture.log_prob(targets).mean() / 4
    assert torch.allclose(latent_loss(predicted, targets, torch.ones(2, 5)), wanted, atol=1e-5)
