"""Layers one after the other: a network that knows nothing of grids."""

from __future__ import annotations

import itertools

import torch
from torch import nn

from rl2grid.algorithms.networks import Network, Request


def build(request: Request) -> nn.Sequential:
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
    return nn.Sequential(*modules)


NETWORK = Network("mlp", build)
