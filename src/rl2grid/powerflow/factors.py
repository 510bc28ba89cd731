"""Sparse LU factors of a matrix with one or two rows per node, without pivoting.

The diagonal blocks, 1 x 1 where a generator holds the voltage and else 2 x 2, are inverted; the blocks before them
become multipliers. Indices are unsigned, because Numba checks signed ones for being negative.

All functions work on one matrix, or on matrices of one pattern side by side, whose values are lanes
(:mod:`rl2grid.powerflow.lanes`): the bits of each are the same.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rl2grid.arrays import F64, U16, Index
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.flow_state import Factors
from rl2grid.powerflow.lanes import entries, like, magnitude, where_less

ONE, TWO, THREE = np.uint64(1), np.uint64(2), np.uint64(3)
_SINGULAR = 1e-14
"""A block whose determinant is this much smaller than the products it is made of cannot be inverted."""
_value_at, _set_value = entries(1)
_row_at, _set_row = entries(2)


@borrowing_jit
def factorise(factors: Factors) -> Any:
    """Replace the matrix in ``factors.panel`` by its factors; 1.0, or 0.0 if it is singular."""
    first_unknown, node_of_unknown = factors.first_unknown, factors.node_of_unknown
    first_column, own_column = factors.first_column, factors.own_column
    first_panel, own_panel = factors.first_panel, factors.own_panel
    column, panel, row = factors.column, factors.panel, factors.sparse_row
    sound = like(_value_at(panel, 0), 1.0)
    for node in range(factors.n_free):
        begin, own, end = first_column[node], own_column[node], first_column[node + 1]
        unknown, start = np.uint64(first_unknown[node]), first_panel[node]
        is_pair = first_unknown[node + 1] - first_unknown[node] == 2
        if is_pair:
            _load_pair(row, begin, end, start, column, panel)
        else:
            _load_single(row, begin, end, start, column, panel)
        largest = magnitude(_row_at(row, TWO * unknown))
        q = np.uint64(begin)
        while q < own:
            k = node_of_unknown[column[q]]
            k_next = k + ONE
            if is_pair:
                q += _eliminate_from_pair(
                    row, first_unknown[k], first_unknown[k_next], own_column[k], first_column[k_next], own_panel[k],
                    column, panel,
                )  # fmt: skip
            else:
                q += _eliminate_from_single(
                    row, first_unknown[k], first_unknown[k_next], own_column[k], first_column[k_next], own_panel[k],
                    column, panel,
                )  # fmt: skip
        if is_pair:
            sound = where_less(_invert_pair(row, unknown), 0.0, sound, 0.0)
            _store_pair(row, begin, end, start, column, panel)
        else:
            own_value = _row_at(row, TWO * unknown)
            sound = where_less(_SINGULAR * largest, magnitude(own_value), sound, 0.0)
            _set_row(row, TWO * unknown, 1.0 / own_value)
            _store_single(row, begin, end, start, column, panel)
    return sound


@borrowing_jit
def _load_single(row: F64, begin: Index, end: Index, start: Index, column: U16, panel: F64) -> None:
    at = np.uint64(start)
    for q in range(begin, end):
        _set_row(row, TWO * column[q], _value_at(panel, at))
        at += ONE


@borrowing_jit
def _load_pair(row: F64, begin: Index, end: Index, start: Index, column: U16, panel: F64) -> None:
    at = np.uint64(start)
    for q in range(begin, end):
        _set_row(row, TWO * column[q], _value_at(panel, at))
        _set_row(row, TWO * column[q] + ONE, _value_at(panel, at + ONE))
        at += TWO


@borrowing_jit
def _store_single(row: F64, begin: Index, end: Index, start: Index, column: U16, panel: F64) -> None:
    at = np.uint64(start)
    for q in range(begin, end):
        _set_value(panel, at, _row_at(row, TWO * column[q]))
        at += ONE


@borrowing_jit
def _store_pair(row: F64, begin: Index, end: Index, start: Index, column: U16, panel: F64) -> None:
    at = np.uint64(start)
    for q in range(begin, end):
        _set_value(panel, at, _row_at(row, TWO * column[q]))
        _set_value(panel, at + ONE, _row_at(row, TWO * column[q] + ONE))
        at += TWO


@borrowing_jit
def _eliminate_from_single(
    row: F64, unknown: Index, next_unknown: Index, own: Index, end: Index, own_panel: Index, column: U16, panel: F64
) -> np.uint64:
    """Subtract a multiple of a node's rows from one row; how many unknowns the node has."""
    at = np.uint64(own_panel)
    first = TWO * np.uint64(unknown)
    if next_unknown - unknown == 1:
        factor = _row_at(row, first) * _value_at(panel, at)
        _set_row(row, first, factor)
        for q in range(own + ONE, end):
            at += ONE
            other = TWO * column[q]
            _set_row(row, other, _row_at(row, other) - factor * _value_at(panel, at))
        return ONE
    second = first + TWO
    a, b = _row_at(row, first), _row_at(row, second)
    factor0 = a * _value_at(panel, at) + b * _value_at(panel, at + ONE)
    factor1 = a * _value_at(panel, at + TWO) + b * _value_at(panel, at + THREE)
    _set_row(row, first, factor0)
    _set_row(row, second, factor1)
    at += TWO
    for q in range(own + TWO, end):
        at += TWO
        other = TWO * column[q]
        rest = _row_at(row, other) - factor0 * _value_at(panel, at)
        _set_row(row, other, rest - factor1 * _value_at(panel, at + ONE))
    return TWO


@borrowing_jit
def _eliminate_from_pair(
    row: F64, unknown: Index, next_unknown: Index, own: Index, end: Index, own_panel: Index, column: U16, panel: F64
) -> np.uint64:
    """Subtract multiples of a node's rows from two rows; how many unknowns the node has."""
    at = np.uint64(own_panel)
    first = TWO * np.uint64(unknown)
    if next_unknown - unknown == 1:
        inverse = _value_at(panel, at)
        above, below = _row_at(row, first) * inverse, _row_at(row, first + ONE) * inverse
        _set_row(row, first, above)
        _set_row(row, first + ONE, below)
        for q in range(own + ONE, end):
            at += ONE
            value = _value_at(panel, at)
            other = TWO * column[q]
            _set_row(row, other, _row_at(row, other) - above * value)
            _set_row(row, other + ONE, _row_at(row, other + ONE) - below * value)
        return ONE
    second = first + TWO
    i00, i10, i01, i11 = (
        _value_at(panel, at),
        _value_at(panel, at + ONE),
        _value_at(panel, at + TWO),
        _value_at(panel, at + THREE),
    )
    a0, a1, b0, b1 = _row_at(row, first), _row_at(row, first + ONE), _row_at(row, second), _row_at(row, second + ONE)
    above0, above1 = a0 * i00 + b0 * i10, a0 * i01 + b0 * i11
    below0, below1 = a1 * i00 + b1 * i10, a1 * i01 + b1 * i11
    _set_row(row, first, above0)
    _set_row(row, first + ONE, below0)
    _set_row(row, second, above1)
    _set_row(row, second + ONE, below1)
    at += TWO
    for q in range(own + TWO, end):
        at += TWO
        value0, value1 = _value_at(panel, at), _value_at(panel, at + ONE)
        other = TWO * column[q]
        _set_row(row, other, _row_at(row, other) - above0 * value0 - above1 * value1)
        _set_row(row, other + ONE, _row_at(row, other + ONE) - below0 * value0 - below1 * value1)
    return TWO


@borrowing_jit
def _invert_pair(row: F64, unknown: Index) -> Any:
    """Invert the 2 x 2 block of two rows at ``unknown``; a negative number if it could be inverted, else 0 or more."""
    first = TWO * np.uint64(unknown)
    second = first + TWO
    a, b, c, d = _row_at(row, first), _row_at(row, second), _row_at(row, first + ONE), _row_at(row, second + ONE)
    determinant = a * d - b * c
    scale = 1.0 / determinant
    _set_row(row, first, d * scale)
    _set_row(row, first + ONE, -c * scale)
    _set_row(row, second, -b * scale)
    _set_row(row, second + ONE, a * scale)
    return where_less(_SINGULAR * (magnitude(a * d) + magnitude(b * c)), magnitude(determinant), -1.0, 0.0)


@borrowing_jit
def solve(factors: Factors, step: F64) -> None:
    """Turn the right-hand side ``step``, float64 [unknown] or lanes, into the solution."""
    first_unknown, n_free = factors.first_unknown, factors.n_free
    first_column, own_column = factors.first_column, factors.own_column
    first_panel, own_panel = factors.first_panel, factors.own_panel
    column, panel = factors.column, factors.panel
    for node in range(n_free):
        unknown = np.uint64(first_unknown[node])
        at = np.uint64(first_panel[node])
        x = _value_at(step, unknown)
        if first_unknown[node + 1] - first_unknown[node] == 1:
            for q in range(first_column[node], own_column[node]):
                x -= _value_at(panel, at) * _value_at(step, column[q])
                at += ONE
            _set_value(step, unknown, x)
            continue
        y = _value_at(step, unknown + ONE)
        for q in range(first_column[node], own_column[node]):
            known = _value_at(step, column[q])
            x -= _value_at(panel, at) * known
            y -= _value_at(panel, at + ONE) * known
            at += TWO
        _set_value(step, unknown, x)
        _set_value(step, unknown + ONE, y)
    for node in range(n_free - 1, -1, -1):
        unknown = np.uint64(first_unknown[node])
        own = np.uint64(own_panel[node])
        x = _value_at(step, unknown)
        at = own
        if first_unknown[node + 1] - first_unknown[node] == 1:
            for q in range(own_column[node] + ONE, first_column[node + 1]):
                at += ONE
                x -= _value_at(panel, at) * _value_at(step, column[q])
            _set_value(step, unknown, x * _value_at(panel, own))
            continue
        y = _value_at(step, unknown + ONE)
        at += TWO
        for q in range(own_column[node] + TWO, first_column[node + 1]):
            at += TWO
            known = _value_at(step, column[q])
            x -= _value_at(panel, at) * known
            y -= _value_at(panel, at + ONE) * known
        _set_value(step, unknown, x * _value_at(panel, own) + y * _value_at(panel, own + TWO))
        _set_value(step, unknown + ONE, x * _value_at(panel, own + ONE) + y * _value_at(panel, own + THREE))
