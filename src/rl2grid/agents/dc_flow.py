"""The DC approximation of an observed operating point: what planners with linear programmes start from.

Powers in MW, angles in radians. A bus is numbered as in :class:`rl2grid.powerflow.model.Network`: ``sub`` is the
busbar 1 of a substation, ``sub + n_sub`` its busbar 2. A line's flow is ``susceptance * (angle of the origin - angle
of the extremity)``, positive from origin to extremity.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F32, F64, I32
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.mdp.state import GridState
from rl2grid.powerflow.model import Network

_LEAST_SHARE = 0.5
"""Share of a line's apparent-power limit that active power may always use, however much reactive power flows."""
_LEAST_LOADING = 0.05
"""Loadings below say nothing about the limit in MW."""
_BRIDGE = 1e-6
"""Share of a line's flow that finds another way, below which there is none."""
LARGEST_TABLE = 2**23
"""Numbers of a table of sensitivities. The equations behind it are solved anew at every operating point, and what
agents make of it takes a multiple: at half of this a decision takes a minute and up to 10 GB."""


class DcPoint(NamedTuple):
    """An operating point as the DC flow sees it; shapes in brackets."""

    busbar: I32  # [topo] 1 or 2, -1 when off
    injection: F64  # [topo] MW into the grid: productions, minus loads and storage; 0 at line ends
    flow: F64  # [line] MW, as observed (AC) at the origin
    limit: F64  # [line] MW
    susceptance: F64  # [line] MW per radian


def dc_point(state: GridState, i: int, grid: Grid, network: Network) -> DcPoint:
    """The operating point of row ``i`` as last observed.

    The generator that balances the flow makes up for the losses, so that injections sum to zero. The thermal limit in
    A becomes MW at nominal voltage: of the apparent power at the limit, what the reactive power observed now leaves,
    ``sqrt(S_limit**2 - Q**2)``, but at least half of it, and at least the ``|P| / rho`` of now (voltages above nominal
    carry more).
    """
    injection = injections(grid, state.gen_p[i], state.load_p[i], state.storage_power[i])
    flow = state.p_or[i].astype(np.float64)
    per_ampere = np.sqrt(3.0) * network.nominal_voltage[network.line_or_sub] / 1000.0
    apparent, most = per_ampere * state.a_or[i], per_ampere * state.thermal_limit
    reactive_squared = np.maximum(apparent**2 - flow**2, 0.0)
    limit = np.sqrt(np.maximum(most**2 - reactive_squared, (_LEAST_SHARE * most) ** 2))
    limit = np.maximum(limit, np.abs(flow) / np.maximum(state.rho[i], _LEAST_LOADING))
    susceptance = network.line_susceptance * network.base_power[0]
    return DcPoint(state.topo_vect[i].copy(), injection, flow, limit, susceptance)


def injections(grid: Grid, gen_p: F32, load_p: F32, storage_p: F32) -> F64:
    """MW into the grid by element, float64 [topo]: productions, minus loads and storage, that sum to zero.

    The generator that balances the flow makes up for the rest.
    """
    injection = np.zeros(grid.dim_topo)
    injection[grid.gen_pos_topo_vect] = gen_p
    injection[grid.load_pos_topo_vect] = -load_p
    injection[grid.storage_pos_topo_vect] = -storage_p
    injection[grid.gen_pos_topo_vect[grid.slack_gen]] -= injection.sum()
    return injection


def buses(grid: Grid, busbar: I32) -> I32:
    """The bus of each element, int32 [topo]; -1 for one that is off."""
    return np.where(busbar > 0, grid.element_to_subid + grid.n_sub * (busbar - 1), -1).astype(np.int32)


def is_connected(grid: Grid, busbar: I32) -> bool:
    """Whether closed lines join all busbars that have an element."""
    bus = buses(grid, busbar)
    part = connected_parts(bus[grid.line_or_pos_topo_vect], bus[grid.line_ex_pos_topo_vect], 2 * grid.n_sub)
    return len(np.unique(part[bus[bus >= 0]])) == 1


def connected_parts(origin: NDArray[np.integer], extremity: NDArray[np.integer], n_buses: int) -> I32:
    """Which part of the grid each bus is in, int32 [bus]: closed lines join those of a part.

    Args:
        origin: bus at the origin of each line, [line]; -1 for an end that is off, whose line is open.
        extremity: the same at its extremity.
        n_buses: how many buses there are.
    """
    from scipy.sparse import coo_array  # slow to import, and seldom needed: after a game over, and by few agents
    from scipy.sparse.csgraph import connected_components

    closed = (origin >= 0) & (extremity >= 0)
    links = coo_array((np.ones(closed.sum()), (origin[closed], extremity[closed])), shape=(n_buses, n_buses))
    part: I32 = connected_components(links, directed=False)[1]
    return part


def sensitivities(grid: Grid, point: DcPoint) -> F64:
    """MW more on each line per MW more into each bus, float64 [line, bus], taken out where the flow is balanced.

    Open lines and buses without element have zeros. The grid must be connected.

    Raises:
        UsageError: the grid is too large for a dense table.
    """
    if 2 * grid.n_sub * grid.n_line > LARGEST_TABLE:
        raise UsageError(
            f"Agents that plan with DC flows need a table of {grid.n_line:,} x {2 * grid.n_sub:,} numbers on "
            f"{grid.id}, and at most {LARGEST_TABLE:,} are allowed: choose another agent."
        )
    bus = buses(grid, point.busbar)
    origin, extremity = bus[grid.line_or_pos_topo_vect], bus[grid.line_ex_pos_topo_vect]
    closed = np.flatnonzero((origin >= 0) & (extremity >= 0))
    n_bus = 2 * grid.n_sub
    slope = np.zeros((grid.n_line, n_bus))  # flow per angle
    slope[closed, origin[closed]] += point.susceptance[closed]
    slope[closed, extremity[closed]] -= point.susceptance[closed]
    incidence = np.sign(slope)
    slack = bus[grid.gen_pos_topo_vect[grid.slack_gen]]
    used = np.setdiff1d(np.unique(bus[bus >= 0]), [slack])
    result = np.zeros((grid.n_line, n_bus))
    result[:, used] = np.linalg.solve((incidence.T @ slope)[np.ix_(used, used)], slope[:, used].T).T
    return result


def outage_factors(grid: Grid, table: F64, bus: I32, line: int) -> F64 | None:
    """MW more on each line per MW that ``line`` carried, once it is lost, float64 [line]; None: the grid falls apart.

    The loss is as if the line's flow were sent from its origin to its extremity over all others (line outage
    distribution factors); the lost line's own factor is -1.

    Args:
        grid: the grid.
        table: what :func:`sensitivities` returns.
        bus: bus of each element, int32 [topo].
        line: the closed line that is lost.
    """
    ends = grid.line_or_pos_topo_vect[line], grid.line_ex_pos_topo_vect[line]
    transfer = table[:, bus[ends[0]]] - table[:, bus[ends[1]]]
    if abs(1.0 - transfer[line]) < _BRIDGE:
        return None
    factors: F64 = transfer / (1.0 - transfer[line])
    factors[line] = -1.0
    return factors


def dc_flow(grid: Grid, point: DcPoint) -> F64:
    """MW on each line, float64 [line]; 0 on open ones. The grid must be connected."""
    return flow_by(sensitivities(grid, point), grid, point)


def flow_by(table: F64, grid: Grid, point: DcPoint) -> F64:
    """:func:`dc_flow` where the :func:`sensitivities` of the topology are known."""
    bus, on = buses(grid, point.busbar), point.busbar > 0
    flow: F64 = table @ np.bincount(bus[on], point.injection[on], 2 * grid.n_sub)
    return flow
