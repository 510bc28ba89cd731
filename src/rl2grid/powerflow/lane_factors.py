"""Sparse LU factors of many matrices side by side: :mod:`rl2grid.powerflow.factors` with one matrix in each lane.

All lanes share a pattern and an elimination order. Nothing is checked: a lane whose matrix is singular gets numbers
that are not finite, or steps that lead nowhere, and the others do not notice.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from rl2grid.arrays import U16, Index
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.factors import ONE, THREE, TWO
from rl2grid.powerflow.flow_state import Factors
from rl2grid.powerflow.lanes import WIDTH, Lanes, fma, load, splat, store
from rl2grid.structures import allocate, workspace


class LaneFactors(NamedTuple):
    """Matrices of all lanes; their pattern is that of a :class:`rl2grid.powerflow.flow_state.Factors`."""

    panel: Annotated[Lanes, workspace("value lane", "Jacobian, then its factors, as FlowState.panel")]
    sparse_row: Annotated[Lanes, workspace("unknown 2 lane", "of the factorisation")]


def new_lane_factors(n_value: int, n_unknown: int) -> LaneFactors:
    """Room for matrices with ``n_value`` values and ``n_unknown`` rows."""
    return allocate(LaneFactors, {"value": n_value, "unknown": n_unknown, "lane": WIDTH})


@borrowing_jit
def factorise_lanes(factors: Factors, lane_factors: LaneFactors) -> None:
    """Replace the matrices in ``lane_factors.panel`` by their factors."""
    first_unknown, node_of_unknown = factors.first_unknown, factors.node_of_unknown
    first_column, own_column, own_panel = factors.first_column, factors.own_column, factors.own_panel
    column, panel, row = factors.column, lane_factors.panel, lane_factors.sparse_row
    for node in range(factors.n_free):
        begin, own, end = first_column[node], own_column[node], first_column[node + 1]
        unknown, start = first_unknown[node], factors.first_panel[node]
        is_pair = first_unknown[node + 1] - unknown == 2
        if is_pair:
            _load_pair(row, begin, end, start, column, panel)
        else:
            _load_single(row, begin, end, start, column, panel)
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
            _invert_pair(row, unknown)
            _store_pair(row, begin, end, start, column, panel)
        else:
            store(row, TWO * unknown, splat(1.0) / load(row, TWO * unknown))
            _store_single(row, begin, end, start, column, panel)


@borrowing_jit
def _load_single(row: Lanes, begin: Index, end: Index, start: Index, column: U16, panel: Lanes) -> None:
    place = np.uint64(start)
    for q in range(begin, end):
        store(row, TWO * column[q], load(panel, place))
        place += ONE


@borrowing_jit
def _load_pair(row: Lanes, begin: Index, end: Index, start: Index, column: U16, panel: Lanes) -> None:
    place = np.uint64(start)
    for q in range(begin, end):
        store(row, TWO * column[q], load(panel, place))
        store(row, TWO * column[q] + ONE, load(panel, place + ONE))
        place += TWO


@borrowing_jit
def _store_single(row: Lanes, begin: Index, end: Index, start: Index, column: U16, panel: Lanes) -> None:
    place = np.uint64(start)
    for q in range(begin, end):
        store(panel, place, load(row, TWO * column[q]))
        place += ONE


@borrowing_jit
def _store_pair(row: Lanes, begin: Index, end: Index, start: Index, column: U16, panel: Lanes) -> None:
    place = np.uint64(start)
    for q in range(begin, end):
        store(panel, place, load(row, TWO * column[q]))
        store(panel, place + ONE, load(row, TWO * column[q] + ONE))
        place += TWO


@borrowing_jit
def _eliminate_from_single(
    row: Lanes, unknown: Index, next_unknown: Index, own: Index, end: Index, own_panel: Index, column: U16, panel: Lanes
) -> np.uint64:
    """Subtract a multiple of a node's rows from one row; how many unknowns the node has."""
    place = np.uint64(own_panel)
    first = TWO * np.uint64(unknown)
    if next_unknown - unknown == 1:
        factor = load(row, first) * load(panel, place)
        store(row, first, factor)
        for q in range(own + ONE, end):
            place += ONE
            other = TWO * column[q]
            store(row, other, fma(-factor, load(panel, place), load(row, other)))
        return ONE
    second = first + TWO
    a, b = load(row, first), load(row, second)
    factor0 = fma(b, load(panel, place + ONE), a * load(panel, place))
    factor1 = fma(b, load(panel, place + THREE), a * load(panel, place + TWO))
    store(row, first, factor0)
    store(row, second, factor1)
    place += TWO
    for q in range(own + TWO, end):
        place += TWO
        other = TWO * column[q]
        rest = fma(-factor0, load(panel, place), load(row, other))
        store(row, other, fma(-factor1, load(panel, place + ONE), rest))
    return TWO


@borrowing_jit
def _eliminate_from_pair(
    row: Lanes, unknown: Index, next_unknown: Index, own: Index, end: Index, own_panel: Index, column: U16, panel: Lanes
) -> np.uint64:
    """Subtract multiples of a node's rows from two rows; how many unknowns the node has."""
    place = np.uint64(own_panel)
    first = TWO * np.uint64(unknown)
    if next_unknown - unknown == 1:
        inverse = load(panel, place)
        above, below = load(row, first) * inverse, load(row, first + ONE) * inverse
        store(row, first, above)
        store(row, first + ONE, below)
        for q in range(own + ONE, end):
            place += ONE
            value = load(panel, place)
            other = TWO * column[q]
            store(row, other, fma(-above, value, load(row, other)))
            store(row, other + ONE, fma(-below, value, load(row, other + ONE)))
        return ONE
    second = first + TWO
    i00, i10, i01, i11 = (
        load(panel, place),
        load(panel, place + ONE),
        load(panel, place + TWO),
        load(panel, place + THREE),
    )
    a0, a1, b0, b1 = load(row, first), load(row, first + ONE), load(row, second), load(row, second + ONE)
    above0, above1 = fma(b0, i10, a0 * i00), fma(b0, i11, a0 * i01)
    below0, below1 = fma(b1, i10, a1 * i00), fma(b1, i11, a1 * i01)
    store(row, first, above0)
    store(row, first + ONE, below0)
    store(row, second, above1)
    store(row, second + ONE, below1)
    place += TWO
    for q in range(own + TWO, end):
        place += TWO
        value0, value1 = load(panel, place), load(panel, place + ONE)
        other = TWO * column[q]
        store(row, other, fma(-above1, value1, fma(-above0, value0, load(row, other))))
        store(row, other + ONE, fma(-below1, value1, fma(-below0, value0, load(row, other + ONE))))
    return TWO


@borrowing_jit
def _invert_pair(row: Lanes, unknown: Index) -> None:
    """Invert the 2 x 2 blocks of two rows at ``unknown``."""
    first = TWO * np.uint64(unknown)
    second = first + TWO
    a, b, c, d = load(row, first), load(row, second), load(row, first + ONE), load(row, second + ONE)
    scale = splat(1.0) / fma(a, d, -(b * c))
    store(row, first, d * scale)
    store(row, first + ONE, -c * scale)
    store(row, second, -b * scale)
    store(row, second + ONE, a * scale)
