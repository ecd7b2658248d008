"""An LSTM whose units belong to columns of the picture: what is learnt in one column holds in each. Pages: train.md."""

import torch
from torch import Tensor, nn


def in_columns(count: int, side: int) -> Tensor:
    """The kind and the column `(count, 2)` of units of which one after the other lies in each of `side` columns."""
    index = torch.arange(count)
    return torch.stack([index // side, index % side], dim=1)


def in_no_column(count: int) -> Tensor:
    """The kind and -1 `(count, 2)` for units that see the whole picture."""
    return torch.stack([torch.arange(count), torch.full((count,), -1)], dim=1)


def join(*groups: Tensor) -> Tensor:
    """The units `(n, 2)` of all groups, with kinds of its own for each group."""
    kinds = [0]
    for group in groups:
        kinds.append(kinds[-1] + (int(group[:, 0].max()) + 1 if len(group) else 0))
    return torch.cat([group + torch.tensor([first, 0]) for group, first in zip(groups, kinds, strict=False)])


def share_weights(layer: nn.Module, name: str, outputs: Tensor, inputs: Tensor, reach: int) -> None:
    """Let weights of a layer's parameter `name` `(outputs, inputs)` that lie alike in their columns be one weight.

    `outputs` and `inputs` have the kind and the column of each unit. Weights between columns more than `reach` apart
    stay 0. Weights that share begin alike, and their gradients are averaged, so that Adam keeps them alike.
    """
    weight = layer.get_parameter(name)
    places = _number_weights(outputs, inputs, reach)
    connected = places > 0
    layer.register_buffer(f"{name}_places", places, persistent=False)
    counts = torch.bincount(places.flatten()).to(weight.dtype)

    def average(values: Tensor) -> Tensor:
        own = layer.get_buffer(f"{name}_places").flatten()
        sums = values.new_zeros(len(counts)).index_add_(0, own, values.flatten()) / counts.to(values.device)
        sums[0] = 0
        return sums[own].view_as(values)

    bound = float(connected.sum(dim=1).max()) ** -0.5
    with torch.no_grad():
        weight.copy_(((torch.rand(len(counts)) * 2 - 1) * bound)[places] * connected)
    weight.register_hook(average)  # type: ignore[no-untyped-call]


def _number_weights(outputs: Tensor, inputs: Tensor, reach: int) -> Tensor:
    """A number from 1 for each weight `(outputs, inputs)`, the same for those that share; 0 for those that stay 0."""
    kind, column = (part[:, None] for part in outputs.T)
    other, place = inputs.T
    side = int(max(outputs[:, 1].max(), inputs[:, 1].max())) + 1
    both = (column >= 0) & (place >= 0)
    # from each output without a column to each input: a weight of its own; from one with, to an input without: one
    between = torch.where(both, side + column - place, torch.where(column < 0, place + 1, 0))
    numbers = (kind * (int(other.max()) + 1) + other) * 2 * (side + 1) + between
    numbers = torch.where(both & ((column - place).abs() > reach), -1, numbers)
    present, places = torch.unique(numbers, return_inverse=True)
    own: Tensor = places if int(present[0]) < 0 else places + 1
    return own
