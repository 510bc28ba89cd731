"""A dense layer, ``outputs = activation(inputs @ weight.T + bias)``, and its gradients.

All arrays are float32 and C-contiguous. Sums are in the order of their terms, activations are quotients of polynomials:
the same bits on every processor and for every batch.
"""

from __future__ import annotations

import numpy as np

from rl2grid.arrays import F32
from rl2grid.compile import borrowing_jit, jit
from rl2grid.dense.tiles import COLUMNS, ROWS, write_tile

LINEAR, RELU, TANH = 0, 1, 2
"""Activations."""
TERMS = 256
"""Rows of a batch whose products are added up at once: so many rows of a panel are at hand in the nearest cache."""
_LARGEST = np.float32(8.0)
"""From here on the quotient below stays what the hyperbolic tangent is here, 1 - 1.2e-7."""


@jit
def write_layer(inputs: F32, weight: F32, bias: F32, activation: int, outputs: F32) -> None:
    """Write what a layer gives.

    Args:
        inputs: [batch, input].
        weight: [output, input].
        bias: [output].
        activation: :data:`LINEAR`, :data:`RELU` or :data:`TANH`.
        outputs: [batch, output].
    """
    if inputs.shape[0] <= COLUMNS:
        _write_few(inputs, weight, bias, outputs)
    else:
        _write_many(inputs, weight, bias, outputs)
    _activate(outputs, activation)


@jit
def write_panels(weight: F32, panels: F32) -> None:
    """Write a weight as tiles read it, so that :func:`write_layer_of_panels` need not turn it for every batch.

    Args:
        weight: [output, input].
        panels: [:func:`n_panels`, input, COLUMNS] is written, with zeros where there are no more outputs.
    """
    for k in range(panels.shape[0]):
        _transpose_rows(weight, k * COLUMNS, panels[k])


def n_panels(n_outputs: int) -> int:
    """Panels of a weight of so many outputs."""
    return -(-n_outputs // COLUMNS)


@jit
def write_layer_of_panels(inputs: F32, panels: F32, bias: F32, activation: int, outputs: F32) -> None:
    """Write what a layer gives, to the same bits as :func:`write_layer` does, of panels for its weight."""
    tile = np.empty((ROWS, COLUMNS), np.float32)
    for k in range(panels.shape[0]):
        _write_block(inputs, panels[k], bias, k * COLUMNS, tile, outputs)
    _activate(outputs, activation)


@jit
def write_weight_gradients(gradients: F32, inputs: F32, weight: F32, bias: F32) -> None:
    """Write the gradients of a layer's weights.

    Args:
        gradients: [batch, output] of what the layer gives before its activation.
        inputs: [batch, input].
        weight: [output, input] is written.
        bias: [output] is written.
    """
    weight[:] = 0.0
    bias[:] = 0.0
    add_weight_gradients(gradients, inputs, weight, bias)


@jit
def add_weight_gradients(gradients: F32, inputs: F32, weight: F32, bias: F32) -> None:
    """Add to the gradients of a layer's weights; arguments as of :func:`write_weight_gradients`.

    A batch added at once and in parts of :data:`TERMS` rows, the last of which may have less, give the same bits.
    """
    n_rows, n_inputs = inputs.shape
    n_outputs = gradients.shape[1]
    panel, tile = np.empty((min(n_rows, TERMS), COLUMNS), np.float32), np.empty((ROWS, COLUMNS), np.float32)
    for first in range(0, n_rows, TERMS):
        n_terms = min(TERMS, n_rows - first)
        for column in range(0, n_inputs, COLUMNS):
            _copy_columns(inputs[first : first + n_terms], column, panel)
            for row in range(0, n_outputs, ROWS):
                n = min(ROWS, n_outputs - row)
                write_tile(n, gradients, first * n_outputs + row, 1, n_outputs, panel, n_terms, tile)
                _add_tile(tile, n, weight, row, column)
    for row in range(n_rows):
        for output in range(n_outputs):
            bias[output] += gradients[row, output]


@jit
def write_input_gradients(gradients: F32, weight: F32, inputs: F32) -> None:
    """Write the gradients of what a layer reads.

    Args:
        gradients: [batch, output] of what the layer gives before its activation.
        weight: [output, input].
        inputs: [batch, input] is written.
    """
    n_outputs, n_inputs = weight.shape
    n_rows = gradients.shape[0]
    panel, tile = np.empty((n_outputs, COLUMNS), np.float32), np.empty((ROWS, COLUMNS), np.float32)
    for column in range(0, n_inputs, COLUMNS):
        _copy_columns(weight, column, panel)
        for row in range(0, n_rows, ROWS):
            n = min(ROWS, n_rows - row)
            write_tile(n, gradients, row * n_outputs, n_outputs, 1, panel, n_outputs, tile)
            for i in range(n):
                for j in range(min(COLUMNS, n_inputs - column)):
                    inputs[row + i, column + j] = tile[i, j]


@borrowing_jit
def undo_activation(gradients: F32, outputs: F32, activation: int) -> None:
    """Turn gradients of what a layer gives, [batch, output], into those before its activation."""
    gradient, output = gradients.reshape(-1), outputs.reshape(-1)
    if activation == TANH:
        for k in range(output.shape[0]):
            gradient[k] *= np.float32(1.0) - output[k] * output[k]
    elif activation == RELU:
        for k in range(output.shape[0]):
            gradient[k] = gradient[k] if output[k] > 0.0 else np.float32(0.0)


@jit
def _write_few(inputs: F32, weight: F32, bias: F32, outputs: F32) -> None:
    """A layer, before its activation, of no more inputs than a tile has columns: rows of the tile are outputs."""
    n_rows, n_inputs = inputs.shape
    n_outputs = weight.shape[0]
    panel, tile = np.empty((n_inputs, COLUMNS), np.float32), np.empty((ROWS, COLUMNS), np.float32)
    _transpose_rows(inputs, 0, panel)
    for output in range(0, n_outputs, ROWS):
        n = min(ROWS, n_outputs - output)
        write_tile(n, weight, output * n_inputs, n_inputs, 1, panel, n_inputs, tile)
        for i in range(n):
            for row in range(n_rows):
                outputs[row, output + i] = tile[i, row] + bias[output + i]


@jit
def _write_many(inputs: F32, weight: F32, bias: F32, outputs: F32) -> None:
    """A layer, before its activation; rows of a tile are inputs."""
    panel, tile = np.empty((inputs.shape[1], COLUMNS), np.float32), np.empty((ROWS, COLUMNS), np.float32)
    for output in range(0, weight.shape[0], COLUMNS):
        _transpose_rows(weight, output, panel)
        _write_block(inputs, panel, bias, output, tile, outputs)


@borrowing_jit
def _write_block(inputs: F32, panel: F32, bias: F32, output: int, tile: F32, outputs: F32) -> None:
    """What a layer gives before its activation, of the outputs from ``output`` on that a panel has."""
    n_rows, n_inputs = inputs.shape
    columns = min(COLUMNS, outputs.shape[1] - output)
    for row in range(0, n_rows, ROWS):
        n = min(ROWS, n_rows - row)
        write_tile(n, inputs, row * n_inputs, n_inputs, 1, panel, n_inputs, tile)
        for i in range(n):
            for j in range(columns):
                outputs[row + i, output + j] = tile[i, j] + bias[output + j]


@borrowing_jit
def _transpose_rows(matrix: F32, first: int, panel: F32) -> None:
    """Let rows of a matrix from ``first`` on be the columns of a panel; where there are none, zeros."""
    n = min(COLUMNS, matrix.shape[0] - first)
    for k in range(matrix.shape[1]):
        for j in range(COLUMNS):
            panel[k, j] = matrix[first + j, k] if j < n else np.float32(0.0)


@borrowing_jit
def _copy_columns(matrix: F32, first: int, panel: F32) -> None:
    """Let columns of a matrix from ``first`` on be those of a panel; where there are none, zeros."""
    n = min(COLUMNS, matrix.shape[1] - first)
    for k in range(matrix.shape[0]):
        for j in range(n):
            panel[k, j] = matrix[k, first + j]
        for j in range(n, COLUMNS):
            panel[k, j] = 0.0


@borrowing_jit
def _add_tile(tile: F32, n_rows: int, matrix: F32, row: int, column: int) -> None:
    columns = min(COLUMNS, matrix.shape[1] - column)
    for i in range(n_rows):
        for j in range(columns):
            matrix[row + i, column + j] += tile[i, j]


@borrowing_jit
def _activate(outputs: F32, activation: int) -> None:
    numbers = outputs.reshape(-1)
    if activation == TANH:
        for k in range(numbers.shape[0]):
            numbers[k] = _tanh(numbers[k])
    elif activation == RELU:
        for k in range(numbers.shape[0]):
            numbers[k] = max(numbers[k], np.float32(0.0))


@borrowing_jit
def _tanh(x: np.float32) -> np.float32:
    """The hyperbolic tangent, within 4e-7 of its value: x P(x^2) / Q(x^2), fitted by least squares between 0 and 8."""
    x = min(max(x, -_LARGEST), _LARGEST)
    z = x * x
    above = np.float32(1.5230662953058527e-08)
    above = above * z + np.float32(2.189483893744182e-05)
    above = above * z + np.float32(0.0035716090351343155)
    above = above * z + np.float32(0.13444507122039795)
    above = above * z + np.float32(1.0)
    below = np.float32(8.522546863787284e-07)
    below = below * z + np.float32(0.00034113097353838384)
    below = below * z + np.float32(0.02616448514163494)
    below = below * z + np.float32(0.46777835488319397)
    below = below * z + np.float32(1.0)
    return x * above / below
