"""Sparse rows of the inverted factors, and triangular solves of many right-hand sides side by side.

With ``J = L U``, a change of the matrix at a few nodes needs, of each such node, its columns of the inverse of L and
its rows of the inverse of U. Both vanish but on the node's path to the root of the elimination tree.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from rl2grid.arrays import F64, I32, U32, Index
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.factors import ONE, THREE, TWO
from rl2grid.powerflow.flow_state import Factors
from rl2grid.powerflow.lanes import Lanes, fma, lanes_at, load, store
from rl2grid.structures import allocate, workspace

_panel_at = lanes_at(1)
"""A value of factors that all lanes share, or of each lane's own."""


class Paths(NamedTuple):
    """Rows of inverted factors, one slot per node asked for; a node without magnitude has zeros in column 1."""

    size: Annotated[I32, workspace("slot", "unknowns on the path")]
    unknown: Annotated[U32, workspace("slot unknown", "ascending")]
    left: Annotated[F64, workspace("slot unknown 2", "the node's rows of the inverse of U")]
    right: Annotated[F64, workspace("slot unknown 2", "the node's columns of the inverse of L")]
    dense: Annotated[F64, workspace("unknown 4", "zero between calls")]


def new_paths(n_slots: int, n_unknowns: int) -> Paths:
    """Room for ``n_slots`` nodes of a matrix with ``n_unknowns`` rows."""
    return allocate(Paths, {"slot": n_slots, "unknown": n_unknowns})


@borrowing_jit
def write_path(factors: Factors, node: Index, paths: Paths, slot: Index) -> None:
    """Find the path of ``node`` and what the inverted factors hold on it."""
    first_unknown, column = factors.first_unknown, factors.column
    dense = paths.dense
    unknown = np.int64(first_unknown[node])
    dense[unknown, 0] = 1.0
    dense[unknown, 2] = 1.0
    if np.int64(first_unknown[node + 1]) - unknown == 2:
        dense[unknown + 1, 1] = 1.0
        dense[unknown + 1, 3] = 1.0
    size = 0
    while True:
        unknown = np.int64(first_unknown[node])
        rows = np.int64(first_unknown[node + 1]) - unknown
        _finish_right(factors, node, rows, dense)
        _finish_left(factors, node, rows, dense)
        for row in range(unknown, unknown + rows):
            paths.unknown[slot, size] = row
            for side in range(2):
                paths.left[slot, size, side] = dense[row, side]
                paths.right[slot, size, side] = dense[row, 2 + side]
            size += 1
        after = np.int64(factors.own_column[node]) + rows
        if after == np.int64(factors.first_column[node + 1]):
            break
        node = np.int64(factors.node_of_unknown[column[after]])
    paths.size[slot] = size
    for k in range(size):
        for side in range(4):
            dense[paths.unknown[slot, k], side] = 0.0


@borrowing_jit
def _finish_right(factors: Factors, node: Index, rows: Index, dense: F64) -> None:
    """Forward substitution at one node of the path."""
    column, panel = factors.column, factors.panel
    unknown = np.int64(factors.first_unknown[node])
    place = np.uint64(factors.first_panel[node])
    for q in range(factors.first_column[node], factors.own_column[node]):
        first, second = dense[column[q], 2], dense[column[q], 3]
        for row in range(rows):
            dense[unknown + row, 2] -= panel[place] * first
            dense[unknown + row, 3] -= panel[place] * second
            place += ONE


@borrowing_jit
def _finish_left(factors: Factors, node: Index, rows: Index, dense: F64) -> None:
    """Divide by the diagonal block, and hand the rest of the row on."""
    column, panel = factors.column, factors.panel
    unknown = np.int64(factors.first_unknown[node])
    place = np.uint64(factors.own_panel[node])
    for side in range(2):
        a = dense[unknown, side]
        if rows == 1:
            dense[unknown, side] = a * panel[place]
            continue
        b = dense[unknown + 1, side]
        dense[unknown, side] = a * panel[place] + b * panel[place + ONE]
        dense[unknown + 1, side] = a * panel[place + TWO] + b * panel[place + THREE]
    place += np.uint64(rows * rows)
    for q in range(factors.own_column[node] + rows, factors.first_column[node + 1]):
        for row in range(rows):
            value = panel[place]
            dense[column[q], 0] -= dense[unknown + row, 0] * value
            dense[column[q], 1] -= dense[unknown + row, 1] * value
            place += ONE


@borrowing_jit
def write_path_product(paths: Paths, a: Index, b: Index, product: F64) -> None:
    """Block of the inverse between the nodes of two slots, float64 [2, 2]: rows of ``a``, columns of ``b``."""
    product[0, 0] = product[0, 1] = product[1, 0] = product[1, 1] = 0.0
    i, j = np.int64(paths.size[a]) - 1, np.int64(paths.size[b]) - 1
    while i >= 0 and j >= 0 and paths.unknown[a, i] == paths.unknown[b, j]:  # paths that have met stay together
        for p in range(2):
            for q in range(2):
                product[p, q] += paths.left[a, i, p] * paths.right[b, j, q]
        i -= 1
        j -= 1


@borrowing_jit
def solve_forward(factors: Factors, panel: F64, right_hand_sides: Lanes) -> None:
    """Multiply ``right_hand_sides``, lanes [unknown], by the inverse of L.

    Args:
        factors: their pattern.
        panel: their values, ``factors.panel`` or lanes of as many.
        right_hand_sides: turned into the products.
    """
    first_unknown, column = factors.first_unknown, factors.column
    for node in range(factors.n_free):
        unknown = first_unknown[node]
        place = np.uint64(factors.first_panel[node])
        x = load(right_hand_sides, unknown)
        if first_unknown[node + 1] - unknown == 1:
            for q in range(factors.first_column[node], factors.own_column[node]):
                x = fma(-_panel_at(panel, place), load(right_hand_sides, column[q]), x)
                place += ONE
            store(right_hand_sides, unknown, x)
            continue
        y = load(right_hand_sides, unknown + ONE)
        for q in range(factors.first_column[node], factors.own_column[node]):
            known = load(right_hand_sides, column[q])
            x = fma(-_panel_at(panel, place), known, x)
            y = fma(-_panel_at(panel, place + ONE), known, y)
            place += TWO
        store(right_hand_sides, unknown, x)
        store(right_hand_sides, unknown + ONE, y)


@borrowing_jit
def solve_backward(factors: Factors, panel: F64, right_hand_sides: Lanes) -> None:
    """Multiply ``right_hand_sides``, lanes [unknown], by the inverse of U; arguments as of :func:`solve_forward`."""
    first_unknown, column = factors.first_unknown, factors.column
    for node in range(factors.n_free - 1, -1, -1):
        unknown = first_unknown[node]
        own = np.uint64(factors.own_panel[node])
        place = own
        x = load(right_hand_sides, unknown)
        if first_unknown[node + 1] - unknown == 1:
            for q in range(factors.own_column[node] + ONE, factors.first_column[node + 1]):
                place += ONE
                x = fma(-_panel_at(panel, place), load(right_hand_sides, column[q]), x)
            store(right_hand_sides, unknown, x * _panel_at(panel, own))
            continue
        y = load(right_hand_sides, unknown + ONE)
        place += TWO
        for q in range(factors.own_column[node] + TWO, factors.first_column[node + 1]):
            place += TWO
            known = load(right_hand_sides, column[q])
            x = fma(-_panel_at(panel, place), known, x)
            y = fma(-_panel_at(panel, place + ONE), known, y)
        store(right_hand_sides, unknown, fma(y, _panel_at(panel, own + TWO), x * _panel_at(panel, own)))
        store(right_hand_sides, unknown + ONE, fma(y, _panel_at(panel, own + THREE), x * _panel_at(panel, own + ONE)))
