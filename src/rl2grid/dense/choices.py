"""Probabilities of discrete actions, and their gradients: the same bits on every processor.

Rows of logits are float32 [batch, action], legal actions bool of the same shape; those of illegal ones count as
:data:`NEVER`. With probabilities p and logits x,

    log p_a = x_a - log sum over b of exp(x_b)              d log p_a / d x_b = [a = b] - p_b
    H = - sum over a of p_a log p_a                         d H / d x_b = - p_b (log p_b + H)
"""

from __future__ import annotations

import numpy as np

from rl2grid.arrays import F32, I32, I64, Flags, Index
from rl2grid.compile import borrowing_jit, jit

NEVER = -1e8
"""Logit or value of an action that may not be played: never the largest, probability exactly zero in float32, and yet
finite, so that zero times its logarithm is zero."""
_ROUND = np.float32(12582912.0)  # 1.5 * 2**23: adding and subtracting it rounds to the nearest whole number
_LOG2_E = np.float32(1.4426950408889634)
_LOG_2 = 0.6931471805599453
_LOG_2_HIGH = np.float32(0.693359375)  # few digits: its product with a small whole number is exact
_LOG_2_LOW = np.float32(_LOG_2 - 0.693359375)
_LEAST = np.float32(-87.0)
"""Below it, the exponential is as good as zero."""
_ROOT_OF_HALF = 0.7071067811865476
_MANY = 1000
"""As many are found by sorting all."""


@jit
def write_log_softmax(logits: F32, legal: Flags, log_probabilities: F32) -> None:
    """Write log p, float32 [batch, action]."""
    powers = np.empty(logits.shape[1], np.float32)
    for row in range(logits.shape[0]):
        _write_row(logits[row], legal[row], log_probabilities[row], powers)


@borrowing_jit
def write_log_softmax_gradients(gradients: F32, legal: Flags, log_probabilities: F32, logits: F32) -> None:
    """Write the gradients of logits, of those of log p, all float32 [batch, action]."""
    n_rows, n_actions = gradients.shape
    for row in range(n_rows):
        total = 0.0
        for action in range(n_actions):
            total += gradients[row, action]
        whole = np.float32(total)
        for action in range(n_actions):
            gradient = gradients[row, action] - exponential(log_probabilities[row, action]) * whole
            logits[row, action] = gradient if legal[row, action] else np.float32(0.0)


@jit
def write_choices(logits: F32, legal: Flags, actions: I64, log_probabilities: F32, chosen: F32, entropies: F32) -> None:
    """Write the log-probabilities of actions that were chosen, and entropies.

    Args:
        logits: [batch, action].
        legal: [batch, action].
        actions: [batch].
        log_probabilities: [batch, action] is written: of all actions.
        chosen: [batch] is written: of those chosen.
        entropies: [batch] is written.
    """
    n_rows, n_actions = logits.shape
    powers = np.empty(n_actions, np.float32)
    for row in range(n_rows):
        own = log_probabilities[row]
        _write_row(logits[row], legal[row], own, powers)
        for action in range(n_actions):
            powers[action] = exponential(own[action]) * own[action]
        entropy = 0.0
        for action in range(n_actions):
            entropy -= powers[action]
        chosen[row] = own[actions[row]]
        entropies[row] = entropy


@borrowing_jit
def write_choice_gradients(
    of_chosen: F32, of_entropies: F32, legal: Flags, actions: I64, log_probabilities: F32, entropies: F32, logits: F32
) -> None:
    """Write the gradients of logits [batch, action], of those of what :func:`write_choices` wrote."""
    n_rows, n_actions = logits.shape
    for row in range(n_rows):
        own, entropy, first, second = log_probabilities[row], entropies[row], of_chosen[row], of_entropies[row]
        for action in range(n_actions):
            gradient = -exponential(own[action]) * (first + second * (own[action] + entropy))
            logits[row, action] = gradient if legal[row, action] else np.float32(0.0)
        logits[row, actions[row]] += first


@jit
def find_best(values: F32, allowed: Flags, best: I32) -> Index:
    """Find the allowed actions with the largest values.

    Args:
        values: [action], no matter of which those that are not allowed.
        allowed: [action].
        best: [place], not more than there are actions, is written: the actions, the largest value first, of equal ones
            the first action first.

    Returns:
        How many places are written: all, or one for each that is allowed.
    """
    if best.shape[0] >= _MANY:
        return _sort_best(values, allowed, best)
    found: Index = 0
    for action in range(values.shape[0]):
        if not allowed[action]:
            continue
        if found == best.shape[0] and not values[action] > values[best[found - 1]]:
            continue
        place = min(found, best.shape[0] - 1)
        while place > 0 and values[action] > values[best[place - 1]]:
            best[place] = best[place - 1]
            place -= 1
        best[place] = action
        found = min(found + 1, best.shape[0])
    return found


@jit
def _sort_best(values: F32, allowed: Flags, best: I32) -> Index:
    """What :func:`find_best` does, of many places."""
    order = np.argsort(-values, kind="mergesort")
    found: Index = 0
    for k in range(order.shape[0]):
        if allowed[order[k]] and found < best.shape[0]:
            best[found] = order[k]
            found += 1
    return found


@borrowing_jit
def _write_row(logits: F32, legal: Flags, log_probabilities: F32, powers: F32) -> None:
    """One row of log p; loops with and without sums are apart, since only the latter run in SIMD."""
    largest = np.float32(NEVER)
    for action in range(logits.shape[0]):
        logit = logits[action] if legal[action] else np.float32(NEVER)
        log_probabilities[action] = logit
        largest = max(largest, logit)
    for action in range(logits.shape[0]):
        log_probabilities[action] -= largest
        powers[action] = exponential(log_probabilities[action])
    total = 0.0
    for action in range(logits.shape[0]):
        total += powers[action]
    below = np.float32(_log(total))
    for action in range(logits.shape[0]):
        log_probabilities[action] -= below


@borrowing_jit
def exponential(x: np.float32) -> np.float32:
    """The exponential of what is at most 80, within 2e-7 of its value; 0 below -87."""
    whole = (max(x, _LEAST) * _LOG2_E + _ROUND) - _ROUND
    rest = (max(x, _LEAST) - whole * _LOG_2_HIGH) - whole * _LOG_2_LOW
    power = np.float32(1.0 / 5040.0)
    power = power * rest + np.float32(1.0 / 720.0)
    power = power * rest + np.float32(1.0 / 120.0)
    power = power * rest + np.float32(1.0 / 24.0)
    power = power * rest + np.float32(1.0 / 6.0)
    power = power * rest + np.float32(0.5)
    power = power * rest + np.float32(1.0)
    power = power * rest + np.float32(1.0)
    scale = np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)
    small = power * scale if x >= _LEAST else np.float32(0.0)
    return small if x == x else x


@borrowing_jit
def _log(x: float) -> float:
    """The natural logarithm of a normal positive number, from that of its mantissa: 2 atanh((m - 1) / (m + 1))."""
    if not 0.0 < x < np.inf:
        return np.nan
    bits = np.float64(x).view(np.int64)
    exponent = (bits >> 52) - 1022
    mantissa = np.int64((bits & 0x000FFFFFFFFFFFFF) | 0x3FE0000000000000).view(np.float64)  # from 0.5 to 1
    if mantissa < _ROOT_OF_HALF:
        mantissa *= 2.0
        exponent -= 1
    quotient = (mantissa - 1.0) / (mantissa + 1.0)
    square = quotient * quotient
    series = 0.0
    for k in range(17, 0, -2):
        series = series * square + 1.0 / k
    return exponent * _LOG_2 + 2.0 * quotient * series
