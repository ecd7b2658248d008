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
