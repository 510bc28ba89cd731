"""Whether the grid would bear the loss of any line that may be lost soon, by what is published and announced.

May be lost: a line that the opponent is known to attack (but nobody attacks a second line while one is attacked, unless
there are several areas), and a line whose maintenance has been announced for the next five hours.

What a loss does is estimated from the flows last observed and line outage distribution factors d, which follow from the
DC flow of the topology: with line k lost, line l carries ``p_l + d_lk p_k``, and is loaded

    sqrt(rho_l**2 + c_l ((p_l + d_lk p_k)**2 - p_l**2))

where c_l is the square of its loading per MW at nominal voltage: reactive power and voltages stay as they are. What
falls apart without a line does not bear its loss.

The factors of the topology last asked about are kept, by the thread that asks: a heuristic asks at every grid step, and
topologies rarely change.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from rl2grid.arrays import F64, I32, Flags
from rl2grid.compile import jit
from rl2grid.grids import Grid
from rl2grid.grids.network import Network
from rl2grid.mdp.state import GridState
from rl2grid.structures import allocate, constant, workspace

SAFE_LOADING = 0.95
"""After the loss of a line, every other one has to be loaded less, as while the grid is safe."""
SOON = 60
"""Steps before an announced outage from which on the grid is made ready for it."""
_BRIDGE = 1e-6
"""Share of a line's flow that finds another way, below which there is none."""
_SINGULAR = 1e-12
"""Per unit of susceptance: a pivot below means that a bus is cut off."""


class Security(NamedTuple):
    """Which lines of a grid may be lost, and what their losses do in one topology.

    Equations are those of the buses to which a line in service leads, numbered in an order that keeps lines short: the
    matrix of the DC flow has a narrow band then, whatever the topology.
    """

    line: Annotated[I32, constant("contingency", "lines that may be lost")]
    attackable: Annotated[Flags, constant("contingency", "by the opponent")]
    one_area: Annotated[Flags, constant("1", "at most one line is attacked at a time")]
    susceptance: Annotated[F64, constant("line", "flow per angle", "per unit")]
    loading_per_mw: Annotated[F64, constant("line", "at nominal voltage", "1 / MW")]
    order: Annotated[I32, constant("bus", "buses, neighbours near to each other")]

    topo_vect: Annotated[I32, workspace("topo", "topology of the factors below")]
    connected: Annotated[Flags, workspace("1", "no bus that lines lead to is cut off")]
    bandwidth: Annotated[I32, workspace("1", "largest distance of two neighbours' equations")]
    equation: Annotated[I32, workspace("bus", "of each bus; -1 if it has none")]
    matrix: Annotated[F64, workspace("bus band", "lower triangle: entry d of row r is in column r - d; then factors")]
    angle: Annotated[F64, workspace("bus", "by equation")]
    known: Annotated[Flags, workspace("contingency", "its factors have been calculated")]
    bridge: Annotated[Flags, workspace("contingency", "the grid falls apart without it")]
    factor: Annotated[F64, workspace("contingency line", "change of flow per flow on the line that is lost")]


def new_security(grid: Grid, network: Network, attacks: bool) -> Security:
    """What may be lost on ``grid``, nothing calculated yet.

    Args:
        grid: the grid.
        network: its electrical model.
        attacks: whether its opponent attacks.
    """
    attackable = {line for area in grid.opponent.areas for line in area} if attacks else set()
    lines = sorted(attackable | set(grid.maintenance.lines))
    ampere_per_mw = 1000.0 / (np.sqrt(3.0) * network.nominal_voltage[network.line_or_sub])
    n_bus = 2 * grid.n_sub
    order = _bus_order(grid)
    sizes = {"contingency": len(lines), "line": grid.n_line, "bus": n_bus, "topo": grid.dim_topo}
    return allocate(
        Security,
        sizes | {"band": _largest_distance(grid, order) + 1 if lines else 1},
        line=np.array(lines, np.int32),
        attackable=np.array([line in attackable for line in lines], np.bool_),
        one_area=np.array([len(grid.opponent.areas) == 1]),
        susceptance=network.line_susceptance.astype(np.float64),
        loading_per_mw=ampere_per_mw / grid.thermal_limit.astype(np.float64),
        order=order,
    )


def _bus_order(grid: Grid) -> I32:
    """Buses, those of a substation together, in an order of small bandwidth (Cuthill and McKee, 1969)."""
    from scipy.sparse import coo_array  # which takes as long to import as all of this package
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    ends = (grid.line_or_to_subid, grid.line_ex_to_subid)
    links = coo_array((np.ones(grid.n_line), ends), shape=(grid.n_sub, grid.n_sub)).tocsr()
    subs = reverse_cuthill_mckee(links + links.T, symmetric_mode=True)
    return np.stack((subs, subs + grid.n_sub), axis=1).ravel().astype(np.int32)


def _largest_distance(grid: Grid, order: I32) -> int:
    place = np.argsort(order)
    origin, extremity = place[grid.line_or_to_subid], place[grid.line_ex_to_subid]
    return int(np.abs(origin - extremity).max()) + 1


@jit
def is_secure(security: Security, state: GridState, i: int, flows: GridState, j: int) -> bool:
    """Whether no loss that has to be expected would leave a line loaded :data:`SAFE_LOADING` or more.

    Args:
        security: of the thread that asks.
        state: what has to be expected.
        i: its row.
        flows: topology, flows and loadings: ``state``, or a forecast.
        j: its row.
    """
    for k in range(len(security.line)):
        may_be_lost = is_expected(security, state, i, k) and flows.line_status[j, security.line[k]]
        if may_be_lost and not loading_after_loss(security, flows, j, k) < SAFE_LOADING:
            return False
    return True


@jit
def is_expected(security: Security, state: GridState, i: int, k: int) -> bool:
    """Whether the line of contingency ``k`` may be lost soon in row ``i``."""
    begin = state.time_next_maintenance[i, security.line[k]]
    if 0 < begin <= SOON:
        return True
    return bool(security.attackable[k] and not (security.one_area[0] and np.any(state.attacked[i])))


@jit
def loading_after_loss(security: Security, flows: GridState, j: int, k: int) -> float:
    """Largest loading in row ``j`` after the loss of the line of contingency ``k``, which is in service.

    It is infinite if the grid falls apart.
    """
    _follow_topology(security, flows, j)
    if not security.connected[0]:
        return np.inf
    if not security.known[k]:
        _calculate_factors(security, flows, j, k)
    if security.bridge[k]:
        return np.inf
    lost = security.line[k]
    moved, factor, per_mw = np.float64(flows.p_or[j, lost]), security.factor[k], security.loading_per_mw
    rho, power = flows.rho[j], flows.p_or[j]
    worst = 0.0
    for line in range(len(factor)):
        before = np.float64(power[line])
        after = before + factor[line] * moved
        change = per_mw[line] * per_mw[line] * (after * after - before * before)
        square = np.float64(rho[line]) * np.float64(rho[line]) + change
        worst = max(worst, 0.0 if line == lost else square)
    return float(np.sqrt(worst))


@jit
def _follow_topology(security: Security, flows: GridState, j: int) -> None:
    """See that factors are those of the topology of row ``j``."""
    kept, topo_vect = security.topo_vect, flows.topo_vect[j]
    same = True
    for element in range(len(kept)):
        same &= kept[element] == topo_vect[element]
    if same:
        return
    kept[:] = topo_vect
    security.known[:] = False
    n_equations = _number_equations(security, flows, j)
    _fill_matrix(security, flows, j, n_equations)
    security.connected[0] = _factorise(security.matrix, n_equations, security.bandwidth[0])


@jit
def _bus_of(flows: GridState, j: int, sub: int, element: int) -> int:
    """The bus of an element, which is on."""
    return int(sub + (flows.topo_vect[j, element] - 1) * len(flows.sub_info))


@jit
def _ends(flows: GridState, j: int, line: int) -> tuple[int, int]:
    """The buses of a line in service."""
    origin = _bus_of(flows, j, flows.line_or_to_subid[line], flows.line_or_pos_topo_vect[line])
    return origin, _bus_of(flows, j, flows.line_ex_to_subid[line], flows.line_ex_pos_topo_vect[line])


@jit
def _number_equations(security: Security, flows: GridState, j: int) -> int:
    """Number the buses that lines lead to, the slack's excepted; how many they are."""
    used, none = -2, -1
    equation = security.equation
    equation[:] = none
    for line in range(len(flows.thermal_limit)):
        if flows.line_status[j, line]:
            origin, extremity = _ends(flows, j, line)
            equation[origin] = used
            equation[extremity] = used
    slack = flows.gen_pos_topo_vect[flows.slack_gen[0]]
    equation[_bus_of(flows, j, flows.element_to_subid[slack], slack)] = none
    count = 0
    for bus in security.order:
        if equation[bus] == used:
            equation[bus] = count
            count += 1
    return count


@jit
def _fill_matrix(security: Security, flows: GridState, j: int, n_equations: int) -> None:
    """Susceptances of the lines in service."""
    matrix, equation = security.matrix, security.equation
    matrix[:n_equations] = 0.0
    bandwidth = 0
    for line in range(len(flows.thermal_limit)):
        if not flows.line_status[j, line]:
            continue
        origin, extremity = _ends(flows, j, line)
        row, column = equation[origin], equation[extremity]
        if row == column:  # both ends on one bus
            continue
        if row >= 0:
            matrix[row, 0] += security.susceptance[line]
        if column >= 0:
            matrix[column, 0] += security.susceptance[line]
        if row >= 0 and column >= 0:
            distance = abs(row - column)
            matrix[max(row, column), distance] -= security.susceptance[line]
            bandwidth = max(bandwidth, distance)
    security.bandwidth[0] = bandwidth


@jit
def _factorise(matrix: F64, n: int, bandwidth: int) -> bool:
    """Replace a symmetric matrix by its factors L and D, with L's ones left out; False if it is singular."""
    for row in range(n):
        first = max(row - bandwidth, 0)
        own = matrix[row]
        largest = abs(own[0])
        for column in range(first, row):
            other = matrix[column]
            total = own[row - column]
            for k in range(max(first, column - bandwidth), column):
                total -= own[row - k] * other[column - k]
            own[row - column] = total
        pivot = own[0]
        for column in range(first, row):
            scaled = own[row - column] / matrix[column, 0]
            pivot -= scaled * own[row - column]
            own[row - column] = scaled
        own[0] = pivot
        if not abs(pivot) > _SINGULAR * largest:
            return False
    return True


@jit
def _solve(matrix: F64, n: int, bandwidth: int, x: F64) -> None:
    """Turn the right-hand side ``x`` into the solution."""
    for row in range(n):
        for k in range(max(row - bandwidth, 0), row):
            x[row] -= matrix[row, row - k] * x[k]
    for row in range(n):
        x[row] /= matrix[row, 0]
    for row in range(n - 1, -1, -1):
        for k in range(max(row - bandwidth, 0), row):
            x[k] -= matrix[row, row - k] * x[row]


@jit
def _calculate_factors(security: Security, flows: GridState, j: int, k: int) -> None:
    """How much more every line carries per MW that the line of contingency ``k`` carried."""
    equation, angle, factor, lost = security.equation, security.angle, security.factor[k], security.line[k]
    origin, extremity = _ends(flows, j, lost)
    angle[:] = 0.0
    if equation[origin] >= 0:
        angle[equation[origin]] += 1.0
    if equation[extremity] >= 0:
        angle[equation[extremity]] -= 1.0
    _solve(security.matrix, int(np.max(equation)) + 1, security.bandwidth[0], angle)
    for line in range(len(factor)):
        factor[line] = 0.0
        if flows.line_status[j, line]:
            begin, end = _ends(flows, j, line)
            difference = _angle_of(equation, angle, begin) - _angle_of(equation, angle, end)
            factor[line] = security.susceptance[line] * difference
    stays = 1.0 - factor[lost]
    security.known[k] = True
    security.bridge[k] = abs(stays) < _BRIDGE
    if not security.bridge[k]:
        for line in range(len(factor)):
            factor[line] /= stays


@jit
def _angle_of(equation: I32, angle: F64, bus: int) -> float:
    return float(angle[equation[bus]]) if equation[bus] >= 0 else 0.0
