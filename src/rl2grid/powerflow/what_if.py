"""DC what-if: the worst line loading after each topology action, for the whole catalogue at once.

A move of elements splits a substation (or joins, or regroups its two busbars). With the substation
seen as one node ``s``, let ``S`` be the elements that end up on the second busbar, ``d`` the sum of
the susceptances of the lines in ``S``, ``c`` the vector with ``d`` at ``s`` and minus each
susceptance at the far end, and ``X`` the inverse of the node susceptance matrix. The second busbar's
angle then differs from the first one's by

    delta = r / (d - c' X c),    r = injections in S - flows that leave through S,

and the angles change by ``-X c delta``. ``c`` is a sum over the lines in ``S``, so the flow response
of a set follows from that of a subset with one line less by one vector addition; the sets are
visited in an order that makes use of it. A vanishing denominator means that one busbar has no way
to the rest of the grid. Switching a line is the usual rank-one update.

Only active power is redistributed: a line keeps the reactive power and the voltage of the snapshot.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.compile import jit
from rl2grid.grids import Grid
from rl2grid.powerflow.network import Branches, Snapshot

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I32 = NDArray[np.int32]

_SINGULAR = 1e-7
"""Relative size below which a denominator counts as zero: the grid falls apart."""


class _Wiring(NamedTuple):
    """Constants of a grid, as the compiled functions want them."""

    sub_first_element: I32
    sub_info: I32
    element_line: I32  # [topo] the line that ends here, -1 for injections
    element_sign: F64  # [topo] +1 at a line's origin, -1 at its extremity
    line_or_pos: I32
    line_ex_pos: I32
    susceptance: F64


class _Flow(NamedTuple):
    """The base case of one snapshot."""

    inverse: F64  # [node, node] of the node susceptance matrix, zero in the reference's row and column
    theta: F64  # [node]
    node: I32  # [topo] node of each element; of its last busbar when disconnected, -1 if nothing is there
    connected: NDArray[np.bool_]  # [topo]
    size: I32  # [node] connected elements
    injection: F64  # [topo] MW into the grid, 0 at line ends
    topo_vect: I32
    p_or: F64
    q_squared: F64
    loading_scale: F64  # [line] (1000 / (sqrt(3) V limit))^2


class WhatIf:
    """Worst loadings after every topology action of a grid, by DC approximation."""

    def __init__(self, grid: Grid, branches: Branches) -> None:
        self._grid = grid
        self._branches = branches
        element_line = np.full(grid.dim_topo, -1, np.int32)
        element_line[grid.line_or_pos_topo_vect] = element_line[grid.line_ex_pos_topo_vect] = np.arange(grid.n_line)
        element_sign = np.zeros(grid.dim_topo)
        element_sign[grid.line_or_pos_topo_vect] = 1.0
        element_sign[grid.line_ex_pos_topo_vect] = -1.0
        self._wiring = _Wiring(
            grid.sub_first_element,
            grid.sub_info,
            element_line,
            element_sign,
            grid.line_or_pos_topo_vect,
            grid.line_ex_pos_topo_vect,
            branches.susceptance,
        )
        self._n_moves = int((2 ** (grid.sub_info.astype(np.int64) - 1) - 1).sum())

    @property
    def n_actions(self) -> int:
        """Number of actions of the full catalogue."""
        return 1 + self._n_moves + self._grid.n_line

    def worst_loadings(self, snapshot: Snapshot) -> F32:
        """Largest loading of any line after each action, float32 [action]; infinity where the grid falls apart.

        The order is that of :func:`rl2grid.mdp.actions.full_catalogue`: do nothing, moves by
        substation, switches by line. Rules (cooldowns) are not looked at.
        """
        flow = self._base_case(snapshot)
        out = np.empty(self.n_actions, np.float32)
        out[0] = snapshot.loading().max()
        _moves(self._wiring, flow, out[1 : 1 + self._n_moves])
        _switches(self._wiring, flow, out[1 + self._n_moves :])
        return out

    def _base_case(self, snapshot: Snapshot) -> _Flow:
        grid, susceptance = self._grid, self._branches.susceptance
        connected = snapshot.topo_vect > 0
        busbar = np.where(connected, snapshot.topo_vect, snapshot.last_bus)
        raw = grid.element_to_subid + grid.n_sub * (busbar - 1)
        active, size = np.unique(raw[connected], return_counts=True)
        number = np.full(2 * grid.n_sub, -1, np.int32)
        number[active] = np.arange(len(active))
        node = number[raw]

        injection = np.zeros(grid.dim_topo)
        injection[grid.gen_pos_topo_vect] = snapshot.gen_p
        injection[grid.load_pos_topo_vect] = -snapshot.load_p
        injection[grid.storage_pos_topo_vect] = -snapshot.storage_p
        injection[~connected] = 0.0
        slack = grid.gen_pos_topo_vect[grid.slack_gen]
        injection[slack] -= injection.sum()

        closed = connected[grid.line_or_pos_topo_vect] & connected[grid.line_ex_pos_topo_vect]
        origin, extremity = node[grid.line_or_pos_topo_vect][closed], node[grid.line_ex_pos_topo_vect][closed]
        matrix = np.zeros((len(active), len(active)))
        np.add.at(matrix, (origin, origin), susceptance[closed])
        np.add.at(matrix, (extremity, extremity), susceptance[closed])
        np.add.at(matrix, (origin, extremity), -susceptance[closed])
        np.add.at(matrix, (extremity, origin), -susceptance[closed])
        reference = node[slack]
        matrix[reference, :] = matrix[:, reference] = 0.0
        matrix[reference, reference] = 1.0
        inverse: F64 = np.linalg.inv(matrix).astype(np.float64)
        inverse[reference, reference] = 0.0
        theta = inverse @ np.bincount(node[connected], injection[connected], len(active))

        voltage = np.where(closed, snapshot.v_or, self._branches.nominal_voltage)
        scale = (1000 / (np.sqrt(3) * voltage * snapshot.thermal_limit)) ** 2
        return _Flow(
            inverse,
            theta,
            node,
            connected,
            size.astype(np.int32),
            injection,
            snapshot.topo_vect,
            np.where(closed, snapshot.p_or, 0.0),
            np.where(closed, snapshot.q_or, 0.0) ** 2,
            scale,
        )


@jit
def _line_nodes(wiring: _Wiring, flow: _Flow, line: int) -> tuple[int, int]:
    return flow.node[wiring.line_or_pos[line]], flow.node[wiring.line_ex_pos[line]]


@jit
def _is_closed(wiring: _Wiring, flow: _Flow, line: int) -> bool:
    return bool(flow.connected[wiring.line_or_pos[line]] and flow.connected[wiring.line_ex_pos[line]])


@jit
def _closed_susceptance(wiring: _Wiring, flow: _Flow) -> F64:
    susceptance = wiring.susceptance.copy()
    for line in range(susceptance.shape[0]):
        if not _is_closed(wiring, flow, line):
            susceptance[line] = 0.0
    return susceptance


@jit
def _worst(p: F64, q_squared: F64, scale: F64) -> float:
    """Largest loading of any line with active flows ``p``."""
    worst = np.zeros(8)
    n = p.shape[0]
    blocked = n - n % 8
    for begin in range(0, blocked, 8):
        for k in range(8):
            line = begin + k
            squared = (p[line] * p[line] + q_squared[line]) * scale[line]
            worst[k] = squared if squared > worst[k] else worst[k]
    for line in range(blocked, n):
        squared = (p[line] * p[line] + q_squared[line]) * scale[line]
        worst[0] = squared if squared > worst[0] else worst[0]
    return float(np.sqrt(worst.max()))


@jit
def _moves(wiring: _Wiring, flow: _Flow, out: F32) -> None:
    """Worst loading after every move, substations in order, masks in the catalogue's order."""
    susceptance = _closed_susceptance(wiring, flow)
    begin = 0
    for sub in range(wiring.sub_info.shape[0]):
        end = begin + (1 << (wiring.sub_info[sub] - 1)) - 1
        if end > begin:
            _moves_of_substation(wiring, flow, susceptance, sub, out[begin:end])
        begin = end


@jit
def _merged(wiring: _Wiring, flow: _Flow, sub: int) -> tuple[int, int, F64, F64]:
    """The base case with the busbars of ``sub`` joined: its node, the absorbed node, inverse, angles."""
    first, other = -1, -1
    for element in range(wiring.sub_first_element[sub], wiring.sub_first_element[sub] + wiring.sub_info[sub]):
        if not flow.connected[element]:
            continue
        if first < 0:
            first = flow.node[element]
        elif flow.node[element] != first:
            other = flow.node[element]
    if other < 0:
        return first, other, flow.inverse, flow.theta
    gap = flow.inverse[:, first] - flow.inverse[:, other]
    strength = gap[first] - gap[other]
    inverse = flow.inverse.copy()
    for row in range(inverse.shape[0]):
        inverse[row] -= gap * (gap[row] / strength)
    return first, other, inverse, flow.theta - gap * ((flow.theta[first] - flow.theta[other]) / strength)


@jit
def _moves_of_substation(wiring: _Wiring, flow: _Flow, susceptance: F64, sub: int, out: F32) -> None:
    n_line = susceptance.shape[0]
    n = wiring.sub_info[sub]
    start = wiring.sub_first_element[sub]
    node, _, inverse, theta = _merged(wiring, flow, sub)
    unchanged = _worst(flow.p_or, flow.q_squared, flow.loading_scale)
    if node < 0:
        out[:] = unchanged
        return

    # Flows with the busbars joined, as changes of the measured ones.
    joined = np.empty(n_line)
    base = np.empty(n_line)
    for line in range(n_line):
        origin, extremity = _line_nodes(wiring, flow, line)
        base[line] = 0.0
        joined[line] = 0.0
        if susceptance[line] != 0.0:
            base[line] = susceptance[line] * (flow.theta[origin] - flow.theta[extremity])
            joined[line] = susceptance[line] * (theta[origin] - theta[extremity])
    joined_p = flow.p_or + joined - base

    # What each element of the substation brings to the second busbar.
    response = np.zeros((n, n_line))
    weight = np.zeros(n)
    supply = np.zeros(n)
    n_connected = 0
    for k in range(n):
        if not flow.connected[start + k]:
            continue
        n_connected += 1
        line = wiring.element_line[start + k]
        if line < 0:
            supply[k] = flow.injection[start + k]
            continue
        sign = wiring.element_sign[start + k]
        origin, extremity = _line_nodes(wiring, flow, line)
        far = extremity if sign > 0 else origin
        weight[k] = susceptance[line]
        supply[k] = -sign * joined[line]
        angle = (inverse[:, node] - inverse[:, far]) * weight[k]
        for other in range(n_line):
            if susceptance[other] != 0.0:
                at, to = _line_nodes(wiring, flow, other)
                response[k, other] = susceptance[other] * (angle[at] - angle[to])

    # Visit the sets; slot z holds the sums for a number whose lowest set bit is z, slot n - 1 those of number 0.
    sums = np.zeros((n, n_line))
    sum_weight = np.zeros(n)
    sum_supply = np.zeros(n)
    count = np.zeros(n, np.int32)
    second = np.zeros(n, np.bool_)
    root = n - 1
    for k in range(n):
        second[k] = flow.connected[start + k] and flow.topo_vect[start + k] == 2
        if second[k]:
            sums[root] += response[k]
            sum_weight[root] += weight[k]
            sum_supply[root] += supply[k]
            count[root] += 1
    lines_here = np.empty(n, np.int32)
    for k in range(n):
        lines_here[k] = wiring.element_line[start + k] if flow.connected[start + k] else -1
    p = np.empty(n_line)
    member = second.copy()
    for number in range(1, 1 << (n - 1)):
        bit = _lowest_bit(number)
        rest = number & (number - 1)
        parent = root if rest == 0 else _lowest_bit(rest)
        k = n - 1 - bit
        toggle = 0.0
        if flow.connected[start + k]:
            toggle = -1.0 if second[k] else 1.0
        for line in range(n_line):
            sums[bit, line] = sums[parent, line] + toggle * response[k, line]
        sum_weight[bit] = sum_weight[parent] + toggle * weight[k]
        sum_supply[bit] = sum_supply[parent] + toggle * supply[k]
        count[bit] = count[parent] + int(toggle)
        for j in range(1, n):
            member[j] = second[j] != bool(number >> (n - 1 - j) & 1)

        if count[bit] == 0 or count[bit] == n_connected:
            out[number - 1] = _worst(joined_p, flow.q_squared, flow.loading_scale)
            continue
        coupling = 0.0
        for j in range(n):
            if member[j] and lines_here[j] >= 0:
                coupling += wiring.element_sign[start + j] * sums[bit, lines_here[j]]
        denominator = sum_weight[bit] - coupling
        if denominator <= _SINGULAR * sum_weight[bit]:
            out[number - 1] = np.inf
            continue
        delta = sum_supply[bit] / denominator
        for line in range(n_line):
            p[line] = joined_p[line] - delta * sums[bit, line]
        for j in range(n):
            if member[j] and lines_here[j] >= 0:
                p[lines_here[j]] += wiring.element_sign[start + j] * weight[j] * delta
        out[number - 1] = _worst(p, flow.q_squared, flow.loading_scale)


@jit
def _lowest_bit(number: int) -> int:
    bit = 0
    while not number >> bit & 1:
        bit += 1
    return bit


@jit
def _switches(wiring: _Wiring, flow: _Flow, out: F32) -> None:
    """Worst loading after the switch of each line."""
    susceptance = _closed_susceptance(wiring, flow)
    n_line = susceptance.shape[0]
    unchanged = _worst(flow.p_or, flow.q_squared, flow.loading_scale)
    p = np.empty(n_line)
    q_squared = np.empty(n_line)
    for line in range(n_line):
        origin, extremity = _line_nodes(wiring, flow, line)
        if origin < 0 or extremity < 0:
            out[line] = unchanged  # closed onto an empty busbar: a dead end without flow
            continue
        angle = flow.inverse[:, origin] - flow.inverse[:, extremity]
        resistance = wiring.susceptance[line] * (angle[origin] - angle[extremity])
        drop = wiring.susceptance[line] * (flow.theta[origin] - flow.theta[extremity])
        q_squared[:] = flow.q_squared
        if not _is_closed(wiring, flow, line):
            transfer = -drop / (1.0 + resistance)
        elif flow.size[origin] == 1 or flow.size[extremity] == 1:
            transfer = 0.0  # a dead end disappears
            q_squared[line] = 0.0
        elif 1.0 - resistance <= _SINGULAR:
            out[line] = np.inf
            continue
        else:
            transfer = drop / (1.0 - resistance)
            q_squared[line] = 0.0
        for other in range(n_line):
            p[other] = flow.p_or[other]
            if susceptance[other] != 0.0:
                at, to = _line_nodes(wiring, flow, other)
                p[other] += susceptance[other] * (angle[at] - angle[to]) * transfer
        p[line] = 0.0 if _is_closed(wiring, flow, line) else -transfer
        out[line] = _worst(p, q_squared, flow.loading_scale)
