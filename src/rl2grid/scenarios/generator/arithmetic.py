"""Functions that give the same bits on every machine.

The mathematical libraries of processors and compilers differ in the last bit. Everything here is made of
additions, multiplications, divisions and square roots, which IEEE 754 rounds correctly everywhere, in a fixed order.
"""

from __future__ import annotations

import numpy as np

from rl2grid.arrays import F64
from rl2grid.compile import jit
from rl2grid.scenarios.generator.draws import Draws

_TWO_PI = 6.283185307179586
_PART = np.int64(8191)
_SPREAD = 4729.7026332347235
"""Standard deviation of the sum of four uniform integers 0 .. 8191: sqrt(4 * (8192**2 - 1) / 12)."""


@jit
def sine(turns: float) -> float:
    """sin(2 pi turns), to 1e-7."""
    x = turns - np.floor(turns + 0.5)
    if x > 0.25:
        x = 0.5 - x
    elif x < -0.25:
        x = -0.5 - x
    y = x * _TWO_PI
    z = y * y
    series = 1.0 - z / 110.0
    series = 1.0 - z / 72.0 * series
    series = 1.0 - z / 42.0 * series
    series = 1.0 - z / 20.0 * series
    return float(y * (1.0 - z / 6.0 * series))


@jit
def exponential(x: float) -> float:
    """exp(x) for -20 < x < 20, to 1e-6 relative."""
    y = x / 256.0
    power = 1.0 + y * (1.0 + y / 2.0 * (1.0 + y / 3.0 * (1.0 + y / 4.0)))
    for _ in range(8):
        power = power * power
    return power


@jit
def to_gaussian(uniform: float) -> float:
    """A number in [0, 1) as one of mean 0, variance 1 and at most 3.47: the sum of four of its 13-bit parts."""
    bits = np.int64(uniform * 4503599627370496.0)  # 2**52: exact
    total = (bits & _PART) + ((bits >> 13) & _PART) + ((bits >> 26) & _PART) + ((bits >> 39) & _PART)
    return float(total - 16382) / _SPREAD


def gaussians(draws: Draws, n: int) -> F64:
    """``n`` independent numbers of mean 0 and variance 1, float64 [n]."""
    values = draws.uniform(n)
    _to_gaussians(values)
    return values


@jit
def _to_gaussians(values: F64) -> None:
    for k in range(values.size):
        values[k] = to_gaussian(values[k])


@jit
def rounded(value: float) -> int:
    """The nearest integer, halves upwards."""
    return int(np.floor(value + 0.5))
