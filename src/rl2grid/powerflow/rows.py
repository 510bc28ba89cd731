"""AC power flows of many given rows of injections, or after the loss of each line, side by side.

One topology, one flow per lane (:mod:`rl2grid.powerflow.lanes`). Flows start from the voltages of one operating point
that the cold recipe of :func:`rl2grid.powerflow.ac.run_flow` solves without trouble, and go on to the same tolerance;
whatever does not get there quickly, or ends far away, is asked of the cold recipe, whose verdict counts.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rl2grid.arrays import F32, F64, I8, I32, Flags, Index
from rl2grid.compile import borrowing_jit
from rl2grid.errors import UsageError
from rl2grid.grids import Grid, load_grid
from rl2grid.grids.axes import axis_sizes
from rl2grid.handles import Handle, opener
from rl2grid.powerflow.ac import (
    CONVERGED,
    DISCONNECTED,
    DIVERGED,
    FlowState,
    new_flow_state,
    run_flow,
    write_currents,
    write_flow,
)
from rl2grid.powerflow.bridges import find_bridges, find_cuts
from rl2grid.powerflow.factors import factorise
from rl2grid.powerflow.flow_state import ABSENT, Equations, equations_of, factors_of
from rl2grid.powerflow.lane_factors import LaneFactors, new_lane_factors
from rl2grid.powerflow.lane_flow import DONE, EMPTY, FAILED, RUNNING
from rl2grid.powerflow.lanes import WIDTH
from rl2grid.powerflow.model import Network, load_network
from rl2grid.powerflow.newton import fill_jacobian
from rl2grid.powerflow.row_lanes import (
    NO_LINE,
    RowLanes,
    begin_lanes,
    copy_line_flows,
    hold_voltages,
    new_row_lanes,
    put_line_back,
    solve_outages,
    solve_rows,
    take_line_out,
    write_admittance,
    write_line_flows,
)
from rl2grid.structures import allocate, constant, workspace

__all__ = ["CONVERGED", "DISCONNECTED", "DIVERGED", "RowFlows", "RowSolver", "flows", "outages"]

_BASE: Any = np.int64(0)
_ALONE: Any = np.int64(1)
"""Rows of a solver's flow: where lanes start; one flow after another, solved cold."""
_SPARE_STEPS = 3
"""Newton steps that the cold recipe leaves unused on a row near which it can be trusted to find solutions too."""


class Injections(NamedTuple):
    """Rows of injections, as :meth:`RowSolver.flows` describes them."""

    load_p: F32  # [row, load] MW
    load_q: F32  # [row, load] MVAr
    gen_p: F32  # [row, gen] MW
    gen_v: F64  # [row, gen] per unit
    storage_p: F32  # [row, storage] MW


class Cases(NamedTuple):
    """Which flows are asked for."""

    row: I32  # [case] of the injections
    line: I32  # [case] that is lost, or NO_LINE


class RowFlows(NamedTuple):
    """Solved flows; zeros where there is no solution."""

    status: I8  # [case] CONVERGED, DISCONNECTED or DIVERGED, as of rl2grid.powerflow.ac.run_flow
    cold: Flags  # [case] the cold recipe was asked
    a_or: F32  # [case, line] current at the origin, A; 0 on open lines
    p_or: F32  # [case, line] active power entering at the origin, MW; 0 on open lines
    slack_p: F32  # [case] production of the slack generator, MW


class Topology(NamedTuple):
    """What all flows of a solver have in common."""

    topo_vect: Annotated[I32, constant("topo", "busbar of each element, -1 when disconnected")]
    bridge: Annotated[Flags, constant("line", "the line is the only way between its ends")]
    cut: Annotated[Flags, constant("line", "it is, with elements on both sides")]


class Scratch(NamedTuple):
    """Workspace of flows that are solved alone."""

    topo_vect: Annotated[I32, workspace("topo")]
    gen_p: Annotated[F32, workspace("gen", "", "MW")]
    gen_theta: Annotated[F32, workspace("gen", "", "degrees")]
    load_theta: Annotated[F32, workspace("load", "", "degrees")]
    storage_theta: Annotated[F32, workspace("storage", "", "degrees")]


class Sweep(NamedTuple):
    """What a solver keeps, passed on as one handle (:mod:`rl2grid.handles`)."""

    network: Network
    topology: Topology
    flow: FlowState
    lanes: RowLanes
    lane_factors: LaneFactors
    scratch: Scratch


class RowSolver:
    """Solves flows of one topology in one thread; keeps the workspace, so make it once.

    A flow's result depends on its own injections and on the row that flows start from (see :meth:`flows`), bit by
    bit; not on which other flows are asked for.

    Args:
        grid: the grid.
        network: electrical model; of a grid that no system is registered for; None: that of its system.
        topo_vect: [topo] busbar (1 or 2) of each element, -1 when disconnected; None: every element on busbar 1.

    Raises:
        UsageError: a topology of another shape, or with other busbars.
    """

    def __init__(self, grid: Grid, network: Network | None = None, topo_vect: ArrayLike | None = None) -> None:
        self.grid = grid
        self.network = load_network(grid) if network is None else network
        topology = _read_topology(grid, topo_vect)
        sizes = axis_sizes(grid)
        flow = new_flow_state(self.network, 2)
        n_value, n_unknown = flow.panel.shape[1], flow.node_of_unknown.shape[1]
        sweep = Sweep(
            self.network,
            Topology(topology, find_bridges(self.network, topology), find_cuts(self.network, topology)),
            flow,
            new_row_lanes(sizes["bus"], grid.n_line),
            new_lane_factors(n_value, n_unknown),
            allocate(Scratch, sizes),
        )
        self._handle = Handle(sweep)

    def flows(
        self,
        load_p: ArrayLike,
        load_q: ArrayLike,
        gen_p: ArrayLike,
        gen_v: ArrayLike | None = None,
        storage_p: ArrayLike | None = None,
    ) -> RowFlows:
        """The flow of each row of injections.

        All flows start from the first row that the cold recipe solves without trouble: put a typical one first.

        Args:
            load_p: [row, load] MW, used as float32 like all powers.
            load_q: [row, load] MVAr.
            gen_p: [row, gen] MW; the slack generator produces what balances the flow.
            gen_v: [row, gen] set-points, per unit of the nominal voltage, used as float64; None: the network's.
            storage_p: [row, storage] MW, positive charges; None: 0.

        Returns:
            One case per row.

        Raises:
            UsageError: an array of another shape, or not of numbers.
        """
        injections = self._read(load_p, load_q, gen_p, gen_v, storage_p)
        n = len(injections.gen_p)
        return self._solve(injections, Cases(np.arange(n, dtype=np.int32), np.full(n, NO_LINE, np.int32)))

    def outages(
        self,
        load_p: ArrayLike,
        load_q: ArrayLike,
        gen_p: ArrayLike,
        gen_v: ArrayLike | None = None,
        storage_p: ArrayLike | None = None,
        *,
        lines: ArrayLike | None = None,
    ) -> RowFlows:
        """The flow after the loss of each line (N-1), all others as they are.

        Args:
            load_p: [load] MW, and so on as for :meth:`flows`: one row, without its axis.
            load_q: [load] MVAr.
            gen_p: [gen] MW.
            gen_v: [gen] per unit.
            storage_p: [storage] MW.
            lines: [case] those to lose, one at a time; None: every line.

        Returns:
            One case per line to lose; of a line that is open already, the flow as it is.

        Raises:
            UsageError: an array of another shape, or not of numbers, or a line that does not exist.
        """
        row = [None if each is None else np.asarray(each)[None] for each in (load_p, load_q, gen_p, gen_v, storage_p)]
        injections = self._read(*row)
        chosen = np.arange(self.grid.n_line, dtype=np.int32) if lines is None else self._read_lines(lines)
        return self._solve(injections, Cases(np.zeros(len(chosen), np.int32), chosen))

    def _solve(self, injections: Injections, cases: Cases) -> RowFlows:
        n, n_line = len(cases.row), self.grid.n_line
        found = RowFlows(
            np.empty(n, np.int8),
            np.empty(n, np.bool_),
            np.empty((n, n_line), np.float32),
            np.empty((n, n_line), np.float32),
            np.empty(n, np.float32),
        )
        solve_cases(self._handle.address, injections, cases, found)
        return found

    def _read(self, load_p: Any, load_q: Any, gen_p: Any, gen_v: Any, storage_p: Any) -> Injections:
        grid = self.grid
        power = _read_rows("gen_p", gen_p, np.float32, None, grid.n_gen)
        n = len(power)
        if gen_v is None:
            gen_v = np.broadcast_to(self.network.gen_setpoint, (n, grid.n_gen))
        if storage_p is None:
            storage_p = np.zeros((n, grid.n_storage), np.float32)
        return Injections(
            _read_rows("load_p", load_p, np.float32, n, grid.n_load),
            _read_rows("load_q", load_q, np.float32, n, grid.n_load),
            power,
            _read_rows("gen_v", gen_v, np.float64, n, grid.n_gen),
            _read_rows("storage_p", storage_p, np.float32, n, grid.n_storage),
        )

    def _read_lines(self, lines: ArrayLike) -> I32:
        given, n_line = np.asarray(lines), self.grid.n_line
        if given.ndim != 1 or (given.size and given.dtype.kind not in "iu"):
            raise UsageError(f"lines must be a list of line numbers, got shape {given.shape} of {given.dtype}.")
        if ((given < 0) | (given >= n_line)).any():
            raise UsageError(f"lines must be numbers from 0 to {n_line - 1} on {self.grid.id}, got {given.tolist()}.")
        return given.astype(np.int32)


def flows(
    grid_id: str,
    load_p: ArrayLike,
    load_q: ArrayLike,
    gen_p: ArrayLike,
    gen_v: ArrayLike | None = None,
    storage_p: ArrayLike | None = None,
    *,
    topo_vect: ArrayLike | None = None,
) -> RowFlows:
    """AC power flows of rows of injections of a registered grid; see :meth:`RowSolver.flows`.

    ``topo_vect``, [topo], is the topology of all rows; None: every element on busbar 1. Who asks often, of one
    topology, keeps a :class:`RowSolver`.

    Raises:
        UsageError: the grid does not exist, or an array has another shape.
    """
    return _solver(grid_id, topo_vect).flows(load_p, load_q, gen_p, gen_v, storage_p)


def outages(
    grid_id: str,
    load_p: ArrayLike,
    load_q: ArrayLike,
    gen_p: ArrayLike,
    gen_v: ArrayLike | None = None,
    storage_p: ArrayLike | None = None,
    *,
    topo_vect: ArrayLike | None = None,
    lines: ArrayLike | None = None,
) -> RowFlows:
    """AC power flows after the loss of each line of a registered grid; see :meth:`RowSolver.outages`.

    ``topo_vect`` is as for :func:`flows`.

    Raises:
        UsageError: the grid does not exist, an array has another shape, or a line does not exist.
    """
    return _solver(grid_id, topo_vect).outages(load_p, load_q, gen_p, gen_v, storage_p, lines=lines)


def _solver(grid_id: str, topo_vect: ArrayLike | None) -> RowSolver:
    return RowSolver(load_grid(grid_id), topo_vect=topo_vect)


def _read_topology(grid: Grid, topo_vect: ArrayLike | None) -> I32:
    if topo_vect is None:
        return np.ones(grid.dim_topo, np.int32)
    given = np.asarray(topo_vect)
    if given.shape != (grid.dim_topo,) or not np.isin(given, (-1, 1, 2)).all():
        raise UsageError(
            f"topo_vect must hold the busbar 1 or 2, or -1, of each of the {grid.dim_topo} elements of {grid.id}, "
            f"got shape {given.shape} with values {np.unique(given).tolist()}."
        )
    return given.astype(np.int32)


def _read_rows(name: str, value: Any, dtype: Any, n: int | None, width: int) -> Any:
    """An array of rows; ``n`` None: of any number of them."""
    try:
        # A copy of what is read-only, for which everything would be compiled once more.
        array = np.require(value, dtype, ("C", "W"))
    except (TypeError, ValueError):
        raise UsageError(f"{name} must be an array of numbers, [row, {width}].") from None
    if array.ndim != 2 or array.shape[1] != width or n not in (None, len(array)):
        rows = "any number of" if n is None else str(n)
        raise UsageError(f"{name} must have {rows} rows with {width} entries each, got shape {array.shape}.")
    return array


_open_sweep = opener(Sweep)


@borrowing_jit
def solve_cases(address: int, injections: Injections, cases: Cases, found: RowFlows) -> None:
    """Solve flows.

    Args:
        address: of the handle to a :class:`Sweep`.
        injections: rows.
        cases: which flows are asked for; either all of them or none loses a line.
        found: where they are written.
    """
    sweep = _open_sweep(address)
    network, flow, lanes = sweep.network, sweep.flow, sweep.lanes
    n = cases.row.shape[0]
    if not _find_base(sweep, injections):
        for case in range(n):
            _solve_alone(sweep, injections, cases, found, case)
        return
    equations = equations_of(flow, _BASE)
    factors = factors_of(flow, _BASE, flow.column[_BASE], flow.panel[_BASE], flow.sparse_row)
    with_outages = n > 0 and cases.line[0] != NO_LINE
    if with_outages:
        write_admittance(equations, lanes)
    else:
        fill_jacobian(equations, factors)
        factorise(factors)
    case = 0
    while case < n:
        begin_lanes(equations, lanes)
        for lane in range(WIDTH):
            lanes.state[lane] = EMPTY
            while case < n and _is_cut(sweep, cases, case):
                _write_nothing(found, case, DISCONNECTED)
                found.cold[case] = False
                case += 1
            if case < n:
                _place_case(sweep, equations, injections, cases, case, lane)
                case += 1
        if with_outages:
            solve_outages(equations, factors, sweep.lane_factors, lanes, network.tolerance[0])
        else:
            solve_rows(equations, factors, sweep.lane_factors, lanes, network.tolerance[0])
        write_line_flows(network, flow, _BASE, lanes)
        for lane in range(WIDTH):
            if lanes.state[lane] != EMPTY:
                _finish_case(sweep, injections, cases, found, lane)


@borrowing_jit
def _is_cut(sweep: Sweep, cases: Cases, case: Index) -> bool:
    """Whether no flow is possible because the lost line cuts off some element."""
    line = cases.line[case]
    return bool(line != NO_LINE and sweep.topology.cut[line])


@borrowing_jit
def _find_base(sweep: Sweep, injections: Injections) -> bool:
    """Solve the first row that the cold recipe solves without trouble; whether there is one."""
    flow = sweep.flow
    for row in range(injections.gen_p.shape[0]):
        flow.warm[_BASE] = False
        status = run_flow(
            sweep.network, flow, _BASE, sweep.topology.topo_vect, injections.gen_p[row], injections.gen_v[row],
            injections.load_p[row], injections.load_q[row], injections.storage_p[row],
        )  # fmt: skip
        if not flow.connected[_BASE] or not flow.known[_BASE]:
            return False
        if status == CONVERGED and flow.anchor_steps[_BASE] <= sweep.network.max_iterations[0] - _SPARE_STEPS:
            return True
    return False


@borrowing_jit
def _place_case(
    sweep: Sweep, equations: Equations, injections: Injections, cases: Cases, case: Index, lane: Index
) -> None:
    """Let a lane solve a flow, or fail if that is not for lanes."""
    network, flow, lanes = sweep.network, sweep.flow, sweep.lanes
    row, line = cases.row[case], cases.line[case]
    lanes.case[lane] = case
    lanes.state[lane] = RUNNING
    lanes.line[lane] = NO_LINE
    if line != NO_LINE and flow.line_or_node[_BASE, line] != ABSENT:
        if sweep.topology.bridge[line]:
            lanes.state[lane] = FAILED
            return
        lanes.line[lane] = line
        take_line_out(network, flow, _BASE, lanes, lane)
    if not (
        _write_injections(sweep, injections, row, lane)
        and hold_voltages(equations, flow.gen_node[_BASE], injections.gen_v[row], lanes, lane)
    ):
        lanes.state[lane] = FAILED


@borrowing_jit
def _write_injections(sweep: Sweep, injections: Injections, row: Index, lane: Index) -> bool:
    """Write the injections of a lane; False if the cold recipe has to judge them."""
    network, flow, injection = sweep.network, sweep.flow, sweep.lanes.injection
    gen_node, load_node, storage_node = flow.gen_node[_BASE], flow.load_node[_BASE], flow.storage_node[_BASE]
    gen_p, load_p, load_q = injections.gen_p[row], injections.load_p[row], injections.load_q[row]
    storage_p = injections.storage_p[row]
    n_node, scale = np.int64(flow.n_node[_BASE]), 1.0 / network.base_power[0]
    for node in range(n_node):
        injection[node, 0, lane] = 0.0
        injection[node, 1, lane] = 0.0
    for gen in range(gen_node.shape[0]):
        if gen != network.slack_gen[0]:
            injection[gen_node[gen], 0, lane] += scale * np.float64(gen_p[gen])
    for load in range(load_node.shape[0]):
        injection[load_node[load], 0, lane] -= scale * np.float64(load_p[load])
        injection[load_node[load], 1, lane] -= scale * np.float64(load_q[load])
    possible = True
    for storage in range(storage_node.shape[0]):
        if storage_node[storage] == ABSENT:
            possible &= storage_p[storage] == 0.0
        else:
            injection[storage_node[storage], 0, lane] -= scale * np.float64(storage_p[storage])
    return possible and math.isfinite(injection[n_node - 1, 0, lane])  # which no equation contains


@borrowing_jit
def _finish_case(sweep: Sweep, injections: Injections, cases: Cases, found: RowFlows, lane: Index) -> None:
    """Write what a lane has found, or ask the cold recipe."""
    lanes = sweep.lanes
    case = lanes.case[lane]
    if lanes.line[lane] != NO_LINE:
        put_line_back(sweep.flow, _BASE, lanes, lane)
    if lanes.state[lane] != DONE:
        _solve_alone(sweep, injections, cases, found, case)
        return
    found.status[case] = CONVERGED
    found.cold[case] = False
    found.slack_p[case] = lanes.slack_p[0, lane] * sweep.network.base_power[0]
    copy_line_flows(lanes, lane, found.a_or[case], found.p_or[case])


@borrowing_jit
def _solve_alone(sweep: Sweep, injections: Injections, cases: Cases, found: RowFlows, case: Index) -> None:
    """Solve one flow by the cold recipe."""
    network, flow, scratch = sweep.network, sweep.flow, sweep.scratch
    row, line, topo_vect = cases.row[case], cases.line[case], scratch.topo_vect
    for element in range(topo_vect.shape[0]):
        topo_vect[element] = sweep.topology.topo_vect[element]
    if line != NO_LINE:
        topo_vect[network.line_or_position[line]] = -1
        topo_vect[network.line_ex_position[line]] = -1
    flow.warm[_ALONE] = False
    status = run_flow(
        network, flow, _ALONE, topo_vect, injections.gen_p[row], injections.gen_v[row], injections.load_p[row],
        injections.load_q[row], injections.storage_p[row],
    )  # fmt: skip
    found.cold[case] = True
    if status != CONVERGED:
        _write_nothing(found, case, status)
        return
    found.status[case] = CONVERGED
    write_currents(network, flow, _ALONE, found.a_or[case])
    write_flow(
        network, flow, _ALONE, found.p_or[case], scratch.gen_p, scratch.gen_theta, scratch.load_theta,
        scratch.storage_theta,
    )  # fmt: skip
    found.slack_p[case] = scratch.gen_p[network.slack_gen[0]]


@borrowing_jit
def _write_nothing(found: RowFlows, case: Index, status: int) -> None:
    """Write that there is no flow."""
    found.status[case] = status
    found.slack_p[case] = 0.0
    for line in range(found.a_or.shape[1]):
        found.a_or[case, line] = 0.0
        found.p_or[case, line] = 0.0
