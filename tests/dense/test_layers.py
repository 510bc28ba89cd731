"""Layers in compiled code: against NumPy in float64, and bit by bit against themselves in other company."""

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

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
from rl2grid.dense.tiles import COLUMNS, ROWS

SHAPES = [(1, 1, 1), (3, 7, 5), (COLUMNS, 40, 50), (COLUMNS + 1, 211, 128), (300, 64, 1), (600, 33, ROWS + 1)]
"""Batch, inputs, outputs."""
SLOPES = {LINEAR: np.ones_like, RELU: lambda y: (y > 0).astype(float), TANH: lambda y: 1 - y**2}
FUNCTIONS = {LINEAR: lambda x: x, RELU: lambda x: np.maximum(x, 0), TANH: np.tanh}


def numbers(*shape, seed=0):
    return np.random.default_rng([seed, *shape]).normal(size=shape).astype(np.float32)


def layer_of(inputs, weight, bias, activation):
    outputs = np.full((len(inputs), len(weight)), np.nan, np.float32)
    write_layer(inputs, weight, bias, activation, outputs)
    return outputs


@pytest.mark.parametrize("activation", FUNCTIONS)
@pytest.mark.parametrize("shape", SHAPES)
def test_outputs_are_those_of_float64(shape, activation):
    batch, n_inputs, n_outputs = shape
    inputs, weight, bias = numbers(batch, n_inputs), numbers(n_outputs, n_inputs, seed=1), numbers(n_outputs, seed=2)
    exact = FUNCTIONS[activation](inputs.astype(float) @ weight.T.astype(float) + bias)
    # A sum of n terms of order 1 is rounded n times.
    assert np.abs(layer_of(inputs, weight, bias, activation) - exact).max() <= 2e-7 * (n_inputs + 2)


@pytest.mark.parametrize("activation", FUNCTIONS)
@pytest.mark.parametrize("shape", SHAPES)
def test_gradients_are_those_of_float64(shape, activation):
    batch, n_inputs, n_outputs = shape
    inputs, weight, bias = numbers(batch, n_inputs), numbers(n_outputs, n_inputs, seed=1), numbers(n_outputs, seed=2)
    outputs, gradients = layer_of(inputs, weight, bias, activation), numbers(batch, n_outputs, seed=3)
    before = gradients.astype(float) * SLOPES[activation](outputs.astype(float))
    undo_activation(gradients, outputs, activation)
    of_weight, of_bias, of_inputs = (
        np.full_like(weight, np.nan),
        np.full_like(bias, np.nan),
        np.full_like(inputs, np.nan),
    )
    write_weight_gradients(gradients, inputs, of_weight, of_bias)
    write_input_gradients(gradients, weight, of_inputs)
    assert np.abs(of_weight - before.T @ inputs).max() <= 4e-7 * (batch + 2)
    assert np.abs(of_bias - before.sum(axis=0)).max() <= 4e-7 * (batch + 2)
    assert np.abs(of_inputs - before @ weight).max() <= 4e-7 * (n_outputs + 2)


def test_a_row_is_the_same_in_any_batch():
    inputs, weight, bias = numbers(3 * COLUMNS, 211), numbers(50, 211, seed=1), numbers(50, seed=2)
    together = layer_of(inputs, weight, bias, TANH)
    for size in (1, ROWS - 1, COLUMNS, COLUMNS + 1):
        assert np.array_equal(layer_of(inputs[:size], weight, bias, TANH), together[:size])


@pytest.mark.parametrize("activation", FUNCTIONS)
@pytest.mark.parametrize("shape", SHAPES)
def test_panels_of_a_weight_give_the_same_bits(shape, activation):
    batch, n_inputs, n_outputs = shape
    inputs, weight, bias = numbers(batch, n_inputs), numbers(n_outputs, n_inputs, seed=1), numbers(n_outputs, seed=2)
    panels = np.full((n_panels(n_outputs), n_inputs, COLUMNS), np.nan, np.float32)
    write_panels(weight, panels)
    outputs = np.full((batch, n_outputs), np.nan, np.float32)
    write_layer_of_panels(inputs, panels, bias, activation, outputs)
    assert np.array_equal(outputs, layer_of(inputs, weight, bias, activation))


def test_an_output_is_the_same_beside_any_others():
    inputs, weight, bias = numbers(3 * COLUMNS, 211), numbers(50, 211, seed=1), numbers(50, seed=2)
    together = layer_of(inputs, weight, bias, LINEAR)
    assert np.array_equal(layer_of(inputs, weight[:7].copy(), bias[:7].copy(), LINEAR), together[:, :7])


def test_a_product_is_rounded_with_its_sum():
    """(1 + e)^2 - (1 + 2e) is e^2, which is lost where the product is rounded alone."""
    e = np.float32(2.0**-12)
    inputs, weight = np.array([[1, 1 + e]], np.float32), np.array([[-(1 + 2 * e), 1 + e]], np.float32)
    assert layer_of(inputs, weight, np.zeros(1, np.float32), LINEAR)[0, 0] == e * e


def test_tanh_is_close_odd_and_bounded():
    x = np.concatenate([np.linspace(0, 12, 200_001), np.logspace(-30, 0, 10_001)]).astype(np.float32)[:, None]
    one, nothing = np.ones((1, 1), np.float32), np.zeros(1, np.float32)
    y = layer_of(x, one, nothing, TANH)
    exact = np.tanh(x.astype(float))
    assert (np.abs(y - exact) <= 4e-7 * exact).all()
    assert np.array_equal(layer_of(-x, one, nothing, TANH), -y)
    assert y.max() < 1.0


@pytest.mark.parametrize("activation", FUNCTIONS)
def test_what_is_not_a_number_stays_none(activation):
    one, nothing = np.ones((1, 1), np.float32), np.zeros(1, np.float32)
    for batch in (1, COLUMNS + 1):
        inputs = np.zeros((batch, 1), np.float32)
        inputs[-1] = np.nan
        outputs = layer_of(inputs, one, nothing, activation)
        assert np.isnan(outputs[-1]).all()
        assert not np.isnan(outputs[:-1]).any()


def hash_of_gradients():
    """Of what a layer and its gradients are."""
    inputs, weight, bias = numbers(70, 31), numbers(45, 31, seed=1), numbers(45, seed=2)
    outputs, of_weight, of_bias, of_inputs = layer_of(inputs, weight, bias, TANH), weight * 0, bias * 0, inputs * 0
    gradients = outputs.copy()
    undo_activation(gradients, outputs, TANH)
    write_weight_gradients(gradients, inputs, of_weight, of_bias)
    write_input_gradients(gradients, weight, of_inputs)
    return hashlib.sha256(b"".join(a.tobytes() for a in (outputs, of_weight, of_bias, of_inputs))).hexdigest()


@pytest.mark.parametrize("features", ["", "+avx,+avx2,+fma", "+avx,+avx2,+fma,+avx512f"])
@pytest.mark.slow
def test_processors_agree(features, tmp_path):
    environment = os.environ | {
        "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": features, "XDG_CACHE_HOME": str(tmp_path)
    }  # fmt: skip
    code = "import test_layers; print(test_layers.hash_of_gradients())"
    folder = os.path.dirname(__file__)
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=folder, capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == hash_of_gradients()
