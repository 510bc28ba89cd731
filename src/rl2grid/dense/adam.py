"""Steps of Adam (Kingma and Ba, 2015) for weights that lie in one array."""

from __future__ import annotations

import math

import numpy as np

from rl2grid.arrays import F32
from rl2grid.compile import borrowing_jit, jit

FIRST, SECOND = 0.9, 0.999
"""Decays of the moments, Adam's own."""
_PARTS = 16
"""Sums that are made side by side, in registers, and added up in the end."""


@jit
def shorten(gradients: F32, max_norm: float) -> None:
    """Scale gradients down to ``max_norm`` in the Euclidean norm when longer (``torch.nn.utils.clip_grad_norm_``).

    Args:
        gradients: [number].
        max_norm: of all of them.
    """
    n = gradients.shape[0]
    whole = n - n % _PARTS
    parts = np.zeros(_PARTS, np.float32)
    for first in range(0, whole, _PARTS):
        for k in range(_PARTS):
            parts[k] += gradients[first + k] * gradients[first + k]
    for k in range(n - whole):
        parts[k] += gradients[whole + k] * gradients[whole + k]
    square = 0.0
    for k in range(_PARTS):
        square += parts[k]
    norm = math.sqrt(square)
    if not norm + 1e-6 > max_norm:
        return
    factor = np.float32(max_norm / (norm + 1e-6))
    for k in range(n):
        gradients[k] *= factor


@borrowing_jit
def step(
    weights: F32, gradients: F32, means: F32, squares: F32, n_steps: int, learning_rate: float, epsilon: float
) -> None:
    """Move weights down their gradients.

    Args:
        weights: [number] are moved.
        gradients: [number].
        means: [number], of gradients, go on.
        squares: [number], means of squared gradients, go on.
        n_steps: how many steps there have been, this one included.
        learning_rate: length of a step.
        epsilon: added to the root of ``squares``.
    """
    size = np.float32(learning_rate / (1.0 - _power(FIRST, n_steps)))
    scale = np.float32(1.0 / math.sqrt(1.0 - _power(SECOND, n_steps)))
    first, second, least = np.float32(1.0 - FIRST), np.float32(1.0 - SECOND), np.float32(epsilon)
    for k in range(weights.shape[0]):
        gradient = gradients[k]
        mean = means[k] + first * (gradient - means[k])
        square = squares[k] + second * (gradient * gradient - squares[k])
        means[k], squares[k] = mean, square
        weights[k] -= size * mean / (np.sqrt(square) * scale + least)


@borrowing_jit
def _power(base: float, exponent: int) -> float:
    """By squaring: libraries differ in the last place."""
    result = 1.0
    while exponent > 0:
        if exponent % 2 == 1:
            result *= base
        base *= base
        exponent //= 2
    return result
