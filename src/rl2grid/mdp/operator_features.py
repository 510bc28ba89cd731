"""Writes what an operator knows beside the paper's observation: the groups of :mod:`rl2grid.mdp.features`.

These features are asked for by name, so that many rows are written in one call behind their other features.
"""

from __future__ import annotations

import math

import numpy as np

from rl2grid.arrays import F32, I64, Flags
from rl2grid.compile import jit
from rl2grid.grids import STEPS_PER_HOUR
from rl2grid.handles import opener
from rl2grid.mdp.features import OPERATOR_FEATURES
from rl2grid.mdp.security import Security, is_expected, loading_after_loss
from rl2grid.mdp.state import GridState

open_security = opener(Security)
"""From the address of a handle to what may be lost, in compiled code."""

CALENDAR, TRIPS, ATTACKS, SECURITY = range(len(OPERATOR_FEATURES))
"""Places of the groups."""
LARGEST_LOADING = 2.0
"""More than this is not told of a line after the loss of another: protections open it at once."""

_MINUTES = 60 // STEPS_PER_HOUR
_DAY = 24 * 60
_WEEK = 7 * _DAY
_YEAR = 365.2425 * _DAY
"""Minutes: the mean of Gregorian years."""
_MONDAY = 4 * _DAY
"""Minutes from the beginning of 1970, a Thursday, to the first Monday."""
_LONG_AGO = 24 * STEPS_PER_HOUR
"""Steps after which an attack is no longer told from none."""


@jit
def note_attacks(state: GridState, i: int) -> None:
    """Remember after a grid step of row ``i`` which lines the opponent holds."""
    for line in range(state.attacked.shape[1]):
        if state.attacked[i, line]:
            state.attacked_at[i, line] = state.step[i]


@jit
def write_operator_features(
    state: GridState,
    rows: I64,
    groups: Flags,
    began: I64,
    securities: I64,
    overflow_allowed: int,
    begin: int,
    places: I64,
    out: F32,
) -> None:
    """Write what is asked for of some environments, in raw units.

    Args:
        state: of all environments, or a forecast of one.
        rows: of the state, int64 [k].
        groups: which groups are written, one after the other, bool [group].
        began: when the episode of each began, in minutes since 1970, int64 [k].
        securities: addresses of handles to what may be lost in each, int64 [k], where that is asked for.
        overflow_allowed: steps that a line may be overloaded.
        begin: entry of the first feature.
        places: the row of ``out`` for each, int64 [k].
        out: observations, float32 [row, feature].
    """
    for k in range(rows.shape[0]):
        i, own, end = rows[k], out[places[k]], begin
        if groups[CALENDAR]:
            end = _write_calendar(began[k] + _MINUTES * state.step[i], own, end)
        if groups[TRIPS]:
            end = _write_trips(state, i, overflow_allowed, own, end)
        if groups[ATTACKS]:
            end = _write_attacks(state, i, own, end)
        if groups[SECURITY]:
            _write_losses(state, i, open_security(securities[k]), own, end)


@jit
def _write_calendar(minutes: int, out: F32, begin: int) -> int:
    end = _write_angle(minutes % _DAY / _DAY, out, begin)
    end = _write_angle((minutes - _MONDAY) % _WEEK / _WEEK, out, end)
    return _write_angle(minutes % _YEAR / _YEAR, out, end)


@jit
def _write_angle(share: float, out: F32, begin: int) -> int:
    out[begin] = np.float32(math.sin(2 * math.pi * share))
    out[begin + 1] = np.float32(math.cos(2 * math.pi * share))
    return begin + 2


@jit
def _write_trips(state: GridState, i: int, overflow_allowed: int, out: F32, begin: int) -> int:
    n_line = state.timestep_overflow.shape[1]
    for line in range(n_line):
        out[begin + line] = np.float32(overflow_allowed + 1 - state.timestep_overflow[i, line])
    return int(begin + n_line)


@jit
def _write_attacks(state: GridState, i: int, out: F32, begin: int) -> int:
    n_line = state.attacked.shape[1]
    for line in range(n_line):
        out[begin + line] = np.float32(state.attacked[i, line])
        since = state.step[i] - state.attacked_at[i, line] if state.attacked_at[i, line] >= 0 else _LONG_AGO
        out[begin + n_line + line] = np.float32(min(since, _LONG_AGO))
    return int(begin + 2 * n_line)


@jit
def _write_losses(state: GridState, i: int, security: Security, out: F32, begin: int) -> None:
    for line in range(state.rho.shape[1]):
        out[begin + line] = 0.0
    for k in range(len(security.line)):
        line = security.line[k]
        if state.line_status[i, line] and is_expected(security, state, i, k):
            loading = loading_after_loss(security, state, i, k)
            out[begin + line] = np.float32(min(loading, LARGEST_LOADING))
