"""A multilayer perceptron: dense layers one after the other, and the gradients of all their weights.

Its numbers lie in one array, float32: of each layer in turn the weight [output, input] and the bias [output]. So do
gradients of them. What layers give is in one array as well, layer after layer, each [batch, output].
"""

from __future__ import annotations

from rl2grid.arrays import F32, I64
from rl2grid.compile import jit
from rl2grid.dense.layers import add_weight_gradients, undo_activation, write_input_gradients, write_layer


@jit
def n_outputs_of(widths: I64) -> int:
    """Numbers that the layers give for an input."""
    count = 0
    for k in range(1, widths.shape[0]):
        count += widths[k]
    return count


@jit
def write_outputs(inputs: F32, widths: I64, activations: I64, weights: F32, outputs: F32) -> None:
    """Write what all layers give.

    Args:
        inputs: [batch, input].
        widths: [layer + 1], of the inputs and of what each layer gives.
        activations: [layer], see :mod:`rl2grid.dense.layers`.
        weights: [number] of the perceptron.
        outputs: [batch * :func:`n_outputs_of`, or more] is written.
    """
    n_rows = inputs.shape[0]
    given = inputs
    at = first = 0
    for k in range(activations.shape[0]):
        n_in, n_out = widths[k], widths[k + 1]
        bias = first + n_in * n_out
        weight = weights[first:bias].reshape((n_out, n_in))
        output = outputs[at : at + n_rows * n_out].reshape((n_rows, n_out))
        write_layer(given, weight, weights[bias : bias + n_out], activations[k], output)
        given, at, first = output, at + n_rows * n_out, bias + n_out


@jit
def add_gradients(
    inputs: F32, widths: I64, activations: I64, weights: F32, outputs: F32, of_outputs: F32, gradients: F32
) -> None:
    """Add the gradients of a batch to those of the weights.

    Args:
        inputs: as for :func:`write_outputs`.
        widths: likewise.
        activations: likewise.
        weights: likewise.
        outputs: what that wrote.
        of_outputs: gradients of them, in the same places: given for the last layer, written for those before.
        gradients: [number] of the perceptron, added to.
    """
    n_rows = inputs.shape[0]
    at, first = n_rows * n_outputs_of(widths), weights.shape[0]
    for k in range(activations.shape[0] - 1, -1, -1):
        n_in, n_out = widths[k], widths[k + 1]
        bias = first - n_out
        first = bias - n_in * n_out
        at -= n_rows * n_out
        gradient = of_outputs[at : at + n_rows * n_out].reshape((n_rows, n_out))
        undo_activation(gradient, outputs[at : at + n_rows * n_out].reshape((n_rows, n_out)), activations[k])
        before = at - n_rows * n_in
        given = inputs if k == 0 else outputs[before:at].reshape((n_rows, n_in))
        weight = gradients[first:bias].reshape((n_out, n_in))
        add_weight_gradients(gradient, given, weight, gradients[bias : bias + n_out])
        if k > 0:
            weight = weights[first:bias].reshape((n_out, n_in))
            write_input_gradients(gradient, weight, of_outputs[before:at].reshape((n_rows, n_in)))
