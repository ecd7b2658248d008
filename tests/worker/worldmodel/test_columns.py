"""worker/worldmodel/columns.py: units in columns, and weights that they share."""

import pytest
import torch

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN, latent_loss
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae import VAE
from dreamfleet.worker.worldmodel.vae_config import VAEConfig

CONFIGS = {
    "plain": MDNRNNConfig(latent=32, columns=2, hidden=68, mixtures=3, reward="none"),
    "heads": MDNRNNConfig(latent=32, columns=2, hidden=64, done=True, previous_reward=True),
}


def train(model, loss):
    optimiser = torch.optim.Adam(model.parameters(), 0.01)
    for _ in range(3):
        optimiser.zero_grad()
        loss().backward()
        optimiser.step()


def check_shared(weight, places):
    for place in places.unique().tolist():
        values = weight.detach()[places == place].unique()
        assert len(values) == 1
        assert (values == 0) == (place == 0)


def test_a_vaes_latents_move_by_a_column_as_the_picture_does():
    torch.manual_seed(0)
    model = VAE(VAEConfig(latent=32, channels=(8, 8), padding="same", columns=2))
    pictures = torch.zeros(1, 3, 64, 64)
    pictures[..., 24:32] = torch.rand(1, 3, 64, 8)
    with torch.no_grad():
        first, second = (model.encode(each)[0].view(2, 16) for each in (pictures, pictures.roll(4, dims=-1)))
    torch.testing.assert_close(first.roll(1, dims=1)[:, 4:12], second[:, 4:12])
    assert first.std(dim=1).min() > 0


@pytest.mark.parametrize("name", CONFIGS)
def test_an_mdnrnns_shared_weights_stay_equal_and_the_others_zero(name):
    torch.manual_seed(0)
    config = CONFIGS[name]
    model = MDNRNN(config)

    def loss():
        prediction = model(torch.randn(2, 5, config.inputs))
        total = latent_loss(prediction, torch.randn(2, 5, 32), torch.ones(2, 5))
        return total + prediction.done.square().mean() + prediction.reward.square().mean()

    train(model, loss)
    check_shared(model.lstm.weight_ih_l0, model.lstm.weight_ih_l0_places)
    check_shared(model.lstm.weight_hh_l0, model.lstm.weight_hh_l0_places)


def test_what_lies_a_column_beside_another_moves_units_and_predictions_by_a_column():
    torch.manual_seed(0)
    config = CONFIGS["plain"]
    model = MDNRNN(config)
    units = config.column_units * 16
    assert units == 48
    with torch.no_grad():
        model.lstm.bias_ih_l0.zero_()
        for layer in (model.heads.near, model.heads.everywhere, model.heads.second, model.heads.mixtures):
            layer.bias.zero_()
        candidates = 2 * config.hidden
        model.lstm.weight_ih_l0[candidates + units : candidates + config.hidden] = 0  # others stay 0
        step = torch.zeros(1, 1, 2, 16)
        step[..., 8] = torch.tensor([1.0, -2.0])
        moved = step.roll(1, dims=-1)
        inputs = [torch.cat([each.flatten(2), torch.zeros(1, 1, 3)], dim=2) for each in (step, moved)]
        hidden, other = (model.lstm(each)[0] for each in inputs)
        first, second = (model(each).means.view(2, 16, 3) for each in inputs)
    columns, others = (each[..., :units].view(3, 16) for each in (hidden, other))
    assert columns.abs().amax(dim=0).nonzero().flatten().tolist() == [6, 7, 8, 9, 10]
    torch.testing.assert_close(columns.roll(1, dims=1), others)
    assert first.abs().amax(dim=(0, 2)).nonzero().flatten().tolist() == list(range(3, 14))
    torch.testing.assert_close(first.roll(1, dims=1), second)


@pytest.mark.parametrize(
    "given", [{"columns": -1}, {"columns": 3}, {"columns": 2, "hidden": 16}, {"columns": 2, "window": 3}]
)
def test_columns_that_do_not_fit_are_refused(given):
    with pytest.raises(UsageError):
        MDNRNNConfig(**{"latent": 32, "hidden": 64} | given)
