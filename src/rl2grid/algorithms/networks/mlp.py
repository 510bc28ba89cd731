"""Layers one after the other: a network that knows nothing of grids."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rl2grid.algorithms.networks import Network, Request, Style, outputs_by_tensors
from rl2grid.arrays import F32, I64
from rl2grid.dense.layers import (
    LINEAR,
    RELU,
    TANH,
    n_panels,
    undo_activation,
    write_input_gradients,
    write_layer,
    write_layer_of_panels,
    write_panels,
    write_weight_gradients,
)
from rl2grid.dense.tiles import COLUMNS

_ACTIVATIONS: dict[type[Any], int] = {nn.ReLU: RELU, nn.Tanh: TANH}


class Layers(nn.Sequential):
    """Layers one after the other: where there is compiled code for them, with that (:mod:`rl2grid.dense`).

    There is for float32 on a processor, linear layers, ReLU and tanh. What comes out is the same bit by bit whatever
    the batch, the threads and the processor, and whether or not they are frozen.
    """

    _frozen: Sequence[_FrozenLayer] = ()

    def freeze(self) -> None:
        """Keep a copy of all weights, which no longer change, as single observations are read fastest."""
        weights, activations = _weights_and_activations(self._modules.values())
        layers = zip(weights[::2], weights[1::2], activations, strict=True)
        self._frozen = tuple(_frozen_layer(*layer) for layer in layers)

    def outputs_of(self, rows: F32) -> F32:
        """See :func:`rl2grid.algorithms.networks.outputs_of`."""
        return self._outputs_of_frozen(rows) if self._frozen else outputs_by_tensors(self, rows)

    def _outputs_of_frozen(self, rows: F32) -> F32:
        given = rows
        for layer in self._frozen:
            outputs = np.empty((len(given), len(layer.bias)), np.float32)
            write_layer_of_panels(given, layer.panels, layer.bias, layer.activation, outputs)
            given = outputs
        return given

    def forward(self, inputs: Tensor) -> Tensor:
        """Numbers [..., inputs] -> [..., width]."""
        if self._frozen and not torch.is_grad_enabled() and inputs.dtype == torch.float32:
            return torch.from_numpy(self._outputs_of_frozen(_rows(inputs).numpy())).view(*inputs.shape[:-1], -1)
        weights, activations = _weights_and_activations(self._modules.values())
        if not weights or inputs.device.type != "cpu" or inputs.dtype != torch.float32:
            outputs: Tensor = super().forward(inputs)  # type: ignore[no-untyped-call]
            return outputs
        if torch.is_grad_enabled():
            return _Dense.apply(inputs, activations, *weights)  # type: ignore[no-untyped-call, no-any-return]
        return _outputs(_rows(inputs), activations, weights)[-1].view(*inputs.shape[:-1], -1)


def shape_of(network: nn.Module) -> tuple[I64, I64] | None:
    """Widths [layer + 1] and activations [layer] of a network that compiled code knows as a whole; None of any other.

    It knows those whose parameters are the weights and biases of :class:`Layers`, on a processor.
    """
    if not isinstance(network, Layers):
        return None
    weights, activations = _weights_and_activations(network._modules.values())
    if not weights or any(weight.device.type != "cpu" or weight.dtype != torch.float32 for weight in weights):
        return None
    widths = [weights[0].shape[1], *(len(weight) for weight in weights[::2])]
    return np.array(widths, np.int64), np.array(activations, np.int64)


def _weights_and_activations(modules: Iterable[nn.Module | None]) -> tuple[list[Tensor], list[int]]:
    """Weight and bias of every linear layer in turn, and what activates each; none if there is anything else."""
    weights: list[Tensor] = []
    activations: list[int] = []
    for module in modules:
        if isinstance(module, nn.Linear) and module.bias is not None:
            weights += (module.weight, module.bias)
            activations.append(LINEAR)
        elif type(module) in _ACTIVATIONS and activations and activations[-1] == LINEAR:
            activations[-1] = _ACTIVATIONS[type(module)]
        else:
            return [], []
    return weights, activations


def _rows(numbers: Tensor) -> Tensor:
    """Numbers [..., width] as contiguous rows [batch, width]."""
    return numbers.detach().reshape(-1, numbers.shape[-1]).contiguous()


def _outputs(inputs: Tensor, activations: Sequence[int], weights: Sequence[Tensor]) -> list[Tensor]:
    """What every layer gives, each [batch, width]."""
    outputs = []
    for weight, bias, activation in zip(weights[::2], weights[1::2], activations, strict=True):
        output = inputs.new_empty(len(inputs), len(weight))
        write_layer(inputs.numpy(), weight.detach().numpy(), bias.detach().numpy(), activation, output.numpy())
        outputs.append(output)
        inputs = output
    return outputs


class _FrozenLayer(NamedTuple):
    """Weights of a layer as :func:`rl2grid.dense.layers.write_layer_of_panels` takes them."""

    panels: F32
    bias: F32
    activation: int


def _frozen_layer(weight: Tensor, bias: Tensor, activation: int) -> _FrozenLayer:
    panels = np.empty((n_panels(len(weight)), weight.shape[1], COLUMNS), np.float32)
    write_panels(weight.detach().numpy(), panels)
    return _FrozenLayer(panels, bias.detach().numpy().copy(), activation)


class _Dense(torch.autograd.Function):
    """Layers, with their gradients."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, activations: Sequence[int], *weights: Tensor) -> Tensor:
        rows = _rows(inputs)
        outputs = _outputs(rows, activations, weights)
        ctx.activations = activations
        ctx.save_for_backward(rows, *outputs, *weights)
        return outputs[-1].view(*inputs.shape[:-1], -1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        n = len(ctx.activations)
        numbers, weights = ctx.saved_tensors[: n + 1], ctx.saved_tensors[n + 1 :]
        gradient = _rows(gradients[0]).clone()
        of_weights: list[Tensor | None] = [None] * (2 * n)
        for k in reversed(range(n)):
            undo_activation(gradient.numpy(), numbers[k + 1].detach().numpy(), ctx.activations[k])
            weight, bias = weights[2 * k].detach(), weights[2 * k + 1].detach()
            if ctx.needs_input_grad[2 + 2 * k] or ctx.needs_input_grad[3 + 2 * k]:
                mine = torch.empty_like(weight), torch.empty_like(bias)
                write_weight_gradients(gradient.numpy(), numbers[k].numpy(), mine[0].numpy(), mine[1].numpy())
                of_weights[2 * k : 2 * k + 2] = mine
            if k or ctx.needs_input_grad[0]:
                before = torch.empty_like(numbers[k])
                write_input_gradients(gradient.numpy(), weight.numpy(), before.numpy())
                gradient = before
        of_inputs = gradient.view(*gradients[0].shape[:-1], -1) if ctx.needs_input_grad[0] else None
        return of_inputs, None, *of_weights


def build(request: Request) -> Layers:
    """Linear layers of the widths asked for, with activations in between."""
    widths = (request.output.inputs(request.spec), *request.layers, request.output.width(request.spec))
    layers = stacked(widths, request.style, request.generator)
    if request.first_action is not None:
        last: Any = layers[-1]
        with torch.no_grad():
            last.bias[request.output.per_state] = request.first_action
    return layers


def stacked(widths: Sequence[int], style: Style, generator: torch.Generator | None) -> Layers:
    """Linear layers between these widths, with activations in between."""
    modules: list[nn.Module] = []
    for k, (inputs, outputs) in enumerate(itertools.pairwise(widths)):
        last = k == len(widths) - 2
        layer = style.linear(inputs, outputs, last=last, generator=generator)
        modules += [layer] if last else [layer, style.activation()]
    return Layers(*modules)


def freeze(network: nn.Module) -> None:
    """Freeze all :class:`Layers` of a network that learns no more."""
    for module in network.modules():
        if isinstance(module, Layers):
            module.freeze()


NETWORK = Network("mlp", build, row_by_row=True)
