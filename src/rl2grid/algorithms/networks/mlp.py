"""Layers one after the other: a network that knows nothing of grids."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from rl2grid.algorithms.networks import Network, Request


class Layers(nn.Sequential):
    """Layers one after the other, called without what ``Sequential`` and ``Linear`` do around the arithmetic."""

    def forward(self, inputs: Tensor) -> Tensor:
        """Numbers [..., inputs] -> [..., width]."""
        for layer in self._modules.values():
            if isinstance(layer, nn.Linear):
                inputs = nn.functional.linear(inputs, layer.weight, layer.bias)
            else:
                assert layer is not None
                inputs = layer(inputs)
        return inputs


def build(request: Request) -> Layers:
    """Linear layers of the widths asked for, with activations in between."""
    widths = (request.output.inputs(request.spec), *request.layers, request.output.width(request.spec))
    modules: list[nn.Module] = []
    for k, (inputs, outputs) in enumerate(itertools.pairwise(widths)):
        last = k == len(widths) - 2
        layer = request.style.linear(inputs, outputs, last=last, generator=request.generator)
        modules += [layer] if last else [layer, request.style.activation()]
    if request.first_action is not None:
        with torch.no_grad():
            layer.bias[request.output.per_state] = request.first_action
    return Layers(*modules)


NETWORK = Network("mlp", build)
