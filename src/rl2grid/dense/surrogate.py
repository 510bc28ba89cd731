"""Gradients of what PPO minimises (:mod:`rl2grid.algorithms.ppo`) for perceptrons, a block of the batch at a time.

A block goes through all layers and back while it is in the nearer caches.
"""

from __future__ import annotations

import math

import numpy as np

from rl2grid.arrays import F32, F64, I64, Flags
from rl2grid.compile import jit
from rl2grid.dense.choices import exponential, write_choice_gradients, write_choices
from rl2grid.dense.layers import TERMS
from rl2grid.dense.perceptron import add_gradients, n_outputs_of, write_outputs

_LARGEST = np.float32(80.0)
"""A logarithm of a ratio beyond which ratios grow no more, and stay numbers."""
_LEAST_DEVIATION = 1e-8
"""Added to the standard deviation of advantages."""


@jit
def write_policy_gradients(
    rows: I64,
    observations: F32,
    legal: Flags,
    actions: I64,
    log_probabilities: F32,
    advantages: F32,
    widths: I64,
    activations: I64,
    weights: F32,
    clip: float,
    entropy_coefficient: float,
    gradients: F32,
    losses: F64,
) -> None:
    """Gradients of the clipped surrogate and the entropy, of a categorical policy.

    Args:
        rows: [batch], of the transitions that follow.
        observations: [transition, size].
        legal: [transition, action].
        actions: [transition], that were chosen.
        log_probabilities: [transition], of them, when they were.
        advantages: [batch], of ``rows``.
        widths: of the policy's layers, as for :func:`~rl2grid.dense.perceptron.write_outputs`.
        activations: likewise.
        weights: likewise.
        clip: ratios outside of 1 +- this gain nothing.
        entropy_coefficient: weight of the entropy.
        gradients: [number] are written.
        losses: [4] are written: surrogate, entropy, approximate divergence, share of ratios outside.
    """
    n_rows, n_actions = rows.shape[0], legal.shape[1]
    n_outputs = n_outputs_of(widths)
    size = min(n_rows, TERMS)
    block, allowed = np.empty((size, observations.shape[1]), np.float32), np.empty((size, n_actions), np.bool_)
    acted = np.empty(size, np.int64)
    outputs, of_outputs = np.empty(size * n_outputs, np.float32), np.empty(size * n_outputs, np.float32)
    every = np.empty((size, n_actions), np.float32)
    chosen, entropies = np.empty(size, np.float32), np.empty(size, np.float32)
    of_chosen, of_entropies = np.empty(size, np.float32), np.empty(size, np.float32)
    of_entropies[:] = -entropy_coefficient / n_rows
    gradients[:] = 0.0
    losses[:] = 0.0
    for first in range(0, n_rows, TERMS):
        end = min(first + TERMS, n_rows)
        n = end - first
        for k in range(n):
            row = rows[first + k]
            block[k] = observations[row]
            allowed[k] = legal[row]
            acted[k] = actions[row]
        inputs = block[:n]
        write_outputs(inputs, widths, activations, weights, outputs)
        last = n * (n_outputs - n_actions)
        logits = outputs[last : last + n * n_actions].reshape((n, n_actions))
        write_choices(logits, allowed[:n], acted[:n], every[:n], chosen[:n], entropies[:n])
        for k in range(n):
            log_ratio = chosen[k] - log_probabilities[rows[first + k]]
            of_chosen[k] = _surrogate(log_ratio, advantages[first + k], clip, losses) / n_rows
            losses[1] += entropies[k]
        of_logits = of_outputs[last : last + n * n_actions].reshape((n, n_actions))
        write_choice_gradients(
            of_chosen[:n], of_entropies[:n], allowed[:n], acted[:n], every[:n], entropies[:n], of_logits
        )
        add_gradients(inputs, widths, activations, weights, outputs, of_outputs, gradients)
    losses /= n_rows


@jit
def write_value_gradients(
    rows: I64,
    observations: F32,
    old_values: F32,
    returns: F32,
    widths: I64,
    activations: I64,
    weights: F32,
    clip: float,
    coefficient: float,
    gradients: F32,
) -> float:
    """Gradients of half the squared error of a critic; the mean of that.

    Args:
        rows: [batch], of the transitions that follow.
        observations: [transition, size].
        old_values: [transition], what the critic said when the actions were chosen.
        returns: [transition], what it should say.
        widths: of the critic's layers, as for :func:`~rl2grid.dense.perceptron.write_outputs`.
        activations: likewise.
        weights: likewise.
        clip: a change of a value beyond this gains nothing; infinite: any does.
        coefficient: weight of the error in the gradients.
        gradients: [number] are written.
    """
    n_rows = rows.shape[0]
    n_outputs = n_outputs_of(widths)
    size = min(n_rows, TERMS)
    block = np.empty((size, observations.shape[1]), np.float32)
    outputs, of_outputs = np.empty(size * n_outputs, np.float32), np.empty(size * n_outputs, np.float32)
    gradients[:] = 0.0
    total = 0.0
    for first in range(0, n_rows, TERMS):
        end = min(first + TERMS, n_rows)
        n = end - first
        for k in range(n):
            block[k] = observations[rows[first + k]]
        inputs = block[:n]
        write_outputs(inputs, widths, activations, weights, outputs)
        last = n * (n_outputs - 1)
        for k in range(n):
            row = rows[first + k]
            value, wanted, before = outputs[last + k], returns[row], old_values[row]
            error, change = np.float64(value) - wanted, np.float64(value) - before
            clipped = np.float64(before) + min(max(change, -clip), clip) - wanted
            if abs(change) > clip and clipped * clipped > error * error:  # that nothing moves
                of_outputs[last + k] = 0.0
                total += clipped * clipped
            else:
                of_outputs[last + k] = coefficient * error / n_rows
                total += error * error
        add_gradients(inputs, widths, activations, weights, outputs, of_outputs, gradients)
    return float(0.5 * total / n_rows)


@jit
def shift_and_scale(advantages: F32) -> None:
    """Shift and scale advantages, [batch], to mean 0 and deviation 1."""
    n = advantages.shape[0]
    total = 0.0
    for k in range(n):
        total += advantages[k]
    mean = total / n
    square = 0.0
    for k in range(n):
        square += (advantages[k] - mean) ** 2
    deviation = math.sqrt(square / n) + _LEAST_DEVIATION
    for k in range(n):
        advantages[k] = (advantages[k] - mean) / deviation


@jit
def _surrogate(log_ratio: np.float32, advantage: float, clip: float, losses: F64) -> float:
    """Derivative of one transition's loss by the logarithm of its ratio; its losses are added."""
    ratio = np.float64(exponential(min(log_ratio, _LARGEST)))
    free, clipped = advantage * ratio, advantage * min(max(ratio, 1.0 - clip), 1.0 + clip)
    losses[0] -= min(free, clipped)
    losses[2] += ratio - 1.0 - log_ratio
    losses[3] += 1.0 if abs(ratio - 1.0) > clip else 0.0
    return -free if free <= clipped else 0.0
