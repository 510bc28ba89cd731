"""Sparse LU factors of a matrix with one or two rows per node, without pivoting.

The diagonal blocks, 1 x 1 where a generator holds the voltage and else 2 x 2, are inverted; the blocks before them
become multipliers. Indices are unsigned, because Numba checks signed ones for being negative.
"""

from __future__ import annotations

import numpy as np

from rl2grid.arrays import F64, U16, Index
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.flow_state import Factors

ONE, TWO, THREE = np.uint64(1), np.uint64(2), np.uint64(3)
_SINGULAR = 1e-14
"""A block whose determinant is this much smaller than the products it is made of cannot be inverted."""


@borrowing_jit
def factorise(factors: Factors) -> bool:
    """Replace the matrix in ``factors.panel`` by its factors; False if it is singular."""
    first_unknown, node_of_unknown = factors.first_unknown, factors.node_of_unknown
    first_column, own_column = factors.first_column, factors.own_column
    first_panel, own_panel = factors.first_panel, factors.own_panel
    column, panel, row = factors.column, factors.panel, factors.sparse_row
    for node in range(factors.n_free):
        begin, own, end = first_column[node], own_column[node], first_column[node + 1]
        unknown, start = first_unknown[node], first_panel[node]
        is_pair = first_unknown[node + 1] - unknown == 2
        if is_pair:
            _load_pair(row, begin, end, start, column, panel)
        else:
            _load_single(row, begin, end, start, column, panel)
        largest = abs(row[unknown, 0])
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
            if not _invert_pair(row, unknown):
                return False
            _store_pair(row, begin, end, start, column, panel)
        else:
            if not abs(row[unknown, 0]) > _SINGULAR * largest:
                return False
            row[unknown, 0] = 1.0 / row[unknown, 0]
            _store_single(row, begin, end, start, column, panel)
    return True


@borrowing_jit
def _load_single(row: F64, begin: Index, end: Index, start: Index, column: U16, panel: F64) -> None:
    at = np.uint64(start)
    for q in range(begin, end):
        row[column[q], 0] = panel[at]
        at += ONE


@borrowing_jit
def _load_pair(row: F64, begin: Index, end: Index, start: Index, column: U16, panel: F64) -> None:
    at = np.uint64(start)
    for q in range(begin, end):
        row[column[q], 0] = panel[at]
        row[column[q], 1] = panel[at + ONE]
        at += TWO


@borrowing_jit
def _store_single(row: F64, begin: Index, end: Index, start: Index, column: U16, panel: F64) -> None:
    at = np.uint64(start)
    for q in range(begin, end):
        panel[at] = row[column[q], 0]
        at += ONE


@borrowing_jit
def _store_pair(row: F64, begin: Index, end: Index, start: Index, column: U16, panel: F64) -> None:
    at = np.uint64(start)
    for q in range(begin, end):
        panel[at] = row[column[q], 0]
        panel[at + ONE] = row[column[q], 1]
        at += TWO


@borrowing_jit
def _eliminate_from_single(
    row: F64, unknown: Index, next_unknown: Index, own: Index, end: Index, own_panel: Index, column: U16, panel: F64
) -> np.uint64:
    """Subtract a multiple of a node's rows from one row; how many unknowns the node has."""
    at = np.uint64(own_panel)
    if next_unknown - unknown == 1:
        factor = row[unknown, 0] * panel[at]
        row[unknown, 0] = factor
        for q in range(own + ONE, end):
            at += ONE
            row[column[q], 0] -= factor * panel[at]
        return ONE
    second = unknown + ONE
    a, b = row[unknown, 0], row[second, 0]
    factor0 = a * panel[at] + b * panel[at + ONE]
    factor1 = a * panel[at + TWO] + b * panel[at + THREE]
    row[unknown, 0] = factor0
    row[second, 0] = factor1
    at += TWO
    for q in range(own + TWO, end):
        at += TWO
        other = column[q]
        row[other, 0] = row[other, 0] - factor0 * panel[at] - factor1 * panel[at + ONE]
    return TWO


@borrowing_jit
def _eliminate_from_pair(
    row: F64, unknown: Index, next_unknown: Index, own: Index, end: Index, own_panel: Index, column: U16, panel: F64
) -> np.uint64:
    """Subtract multiples of a node's rows from two rows; how many unknowns the node has."""
    at = np.uint64(own_panel)
    if next_unknown - unknown == 1:
        above = row[unknown, 0] * panel[at]
        below = row[unknown, 1] * panel[at]
        row[unknown, 0] = above
        row[unknown, 1] = below
        for q in range(own + ONE, end):
            at += ONE
            value = panel[at]
            other = column[q]
            row[other, 0] -= above * value
            row[other, 1] -= below * value
        return ONE
    second = unknown + ONE
    i00, i10, i01, i11 = panel[at], panel[at + ONE], panel[at + TWO], panel[at + THREE]
    a0, a1, b0, b1 = row[unknown, 0], row[unknown, 1], row[second, 0], row[second, 1]
    above0, above1 = a0 * i00 + b0 * i10, a0 * i01 + b0 * i11
    below0, below1 = a1 * i00 + b1 * i10, a1 * i01 + b1 * i11
    row[unknown, 0] = above0
    row[unknown, 1] = below0
    row[second, 0] = above1
    row[second, 1] = below1
    at += TWO
    for q in range(own + TWO, end):
        at += TWO
        value0, value1 = panel[at], panel[at + ONE]
        other = column[q]
        row[other, 0] = row[other, 0] - above0 * value0 - above1 * value1
        row[other, 1] = row[other, 1] - below0 * value0 - below1 * value1
    return TWO


@borrowing_jit
def _invert_pair(row: F64, unknown: Index) -> bool:
    """Invert the 2 x 2 block of two rows at ``unknown``; False if it is singular."""
    second = unknown + ONE
    a, b, c, d = row[unknown, 0], row[second, 0], row[unknown, 1], row[second, 1]
    determinant = a * d - b * c
    if not abs(determinant) > _SINGULAR * (abs(a * d) + abs(b * c)):
        return False
    scale = 1.0 / determinant
    row[unknown, 0] = d * scale
    row[unknown, 1] = -c * scale
    row[second, 0] = -b * scale
    row[second, 1] = a * scale
    return True


@borrowing_jit
def solve(factors: Factors, step: F64) -> None:
    """Turn the right-hand side ``step``, float64 [unknowns], into the solution."""
    first_unknown, n_free = factors.first_unknown, factors.n_free
    first_column, own_column = factors.first_column, factors.own_column
    first_panel, own_panel = factors.first_panel, factors.own_panel
    column, panel = factors.column, factors.panel
    for node in range(n_free):
        unknown = first_unknown[node]
        at = np.uint64(first_panel[node])
        x = step[unknown]
        if first_unknown[node + 1] - unknown == 1:
            for q in range(first_column[node], own_column[node]):
                x -= panel[at] * step[column[q]]
                at += ONE
            step[unknown] = x
            continue
        y = step[unknown + ONE]
        for q in range(first_column[node], own_column[node]):
            known = step[column[q]]
            x -= panel[at] * known
            y -= panel[at + ONE] * known
            at += TWO
        step[unknown] = x
        step[unknown + ONE] = y
    for node in range(n_free - 1, -1, -1):
        unknown = first_unknown[node]
        own = np.uint64(own_panel[node])
        x = step[unknown]
        at = own
        if first_unknown[node + 1] - unknown == 1:
            for q in range(own_column[node] + ONE, first_column[node + 1]):
                at += ONE
                x -= panel[at] * step[column[q]]
            step[unknown] = x * panel[own]
            continue
        y = step[unknown + ONE]
        at += TWO
        for q in range(own_column[node] + TWO, first_column[node + 1]):
            at += TWO
            known = step[column[q]]
            x -= panel[at] * known
            y -= panel[at + ONE] * known
        step[unknown] = x * panel[own] + y * panel[own + TWO]
        step[unknown + ONE] = x * panel[own + ONE] + y * panel[own + THREE]
