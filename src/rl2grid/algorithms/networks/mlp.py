"""Layers one after the other: a network that knows nothing of grids."""

from __future__ import annotations

import itertools
from typing import Any

import torch
from torch import Tensor, nn

from rl2grid.algorithms.networks import Network, Request


def tanh(inputs: Tensor) -> Tensor:
    """The hyperbolic tangent within 2e-7, in a third of the time of ``torch.tanh``, which takes as long as a layer."""
    return torch.sigmoid(2.0 * inputs).mul_(2.0).sub_(1.0)


class _Tanh(torch.autograd.Function):
    """:func:`tanh`, with the gradient of ``torch.tanh``."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor) -> Tensor:
        outputs = tanh(inputs)
        ctx.save_for_backward(outputs)
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (outputs,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(gradients[0], outputs)  # type: ignore[no-any-return]


class Layers(nn.Sequential):
    """Layers one after the other, called without what ``Sequential`` and ``Linear`` do around the arithmetic."""

    def forward(self, inputs: Tensor) -> Tensor:
        """Numbers [..., inputs] -> [..., width]."""
        for layer in self._modules.values():
            if isinstance(layer, nn.Linear):
                inputs = nn.functional.linear(inputs, layer.weight, layer.bias)
            elif isinstance(layer, nn.Tanh):
                inputs = _Tanh.apply(inputs) if torch.is_grad_enabled() else tanh(inputs)  # type: ignore[no-untyped-call]
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
