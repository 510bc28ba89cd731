"""AC power flows of many changed topologies of one operating point, side by side (``docs/what_if.md``).

Injections are those of the base case; each change moves elements between the busbars of one substation or switches
one line. Flows start from the base case's voltages and use its factors; whatever does not settle quickly, and near
the base case, is asked of the cold recipe of :func:`rl2grid.powerflow.ac.run_flow`, whose verdict counts.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import numpy as np

from rl2grid.arrays import F32, I8, I32, U64, Flags, Index
from rl2grid.compile import borrowing_jit
from rl2grid.grids import Grid
from rl2grid.grids.axes import axis_sizes
from rl2grid.handles import Handle, opener
from rl2grid.powerflow.ac import (
    CONVERGED,
    DISCONNECTED,
    FlowState,
    forget_flow,
    new_flow_state,
    run_flow,
    write_currents,
)
from rl2grid.powerflow.factors import factorise
from rl2grid.powerflow.flow_state import ABSENT, Equations, Factors, equations_of, factors_of
from rl2grid.powerflow.lane_flow import (
    DONE,
    EMPTY,
    RUNNING,
    LaneFlow,
    dismiss_distant_lanes,
    find_worst,
    new_lane_flow,
)
from rl2grid.powerflow.lane_moves import (
    CONNECTED,
    EXTREMITY,
    GENERATOR,
    GENERATORS,
    HAS_SHUNT,
    LARGEST_SITE,
    LINES,
    LOAD,
    LOADS,
    N_ELEMENTS,
    N_PARTS,
    ORIGIN,
    SECOND,
    STORAGE,
    STORAGES,
    Site,
    Wiring,
    new_site,
    open_site,
    place_lane,
    solve_moves,
)
from rl2grid.powerflow.lane_switches import Switches, is_bridge, new_switches, place_switch, solve_switches
from rl2grid.powerflow.lanes import WIDTH
from rl2grid.powerflow.model import Network
from rl2grid.powerflow.newton import fill_jacobian
from rl2grid.powerflow.paths import Paths, new_paths, write_path
from rl2grid.structures import allocate, constant, workspace

NOTHING, MOVE, SWITCH = range(3)
"""Kinds of changes: none; masked elements of a substation to the other busbar; a line opened, or closed."""
SOLVED, LOAD_CUT_OFF, GENERATOR_CUT_OFF, STORAGE_CUT_OFF, ISLAND, NO_SOLUTION = range(6)
"""Verdicts, numbered and ordered as the reasons of a game over (``rl2grid.mdp.termination.GameOver``)."""
UNASKED = -1
"""Instead of the verdict on a change that was not solved."""
_SETPOINT_TOLERANCE = 1e-7
"""Per unit, as in :mod:`rl2grid.powerflow.ac`."""
_WORD_BITS = 64
_BASE: Any = np.int64(0)
_ALONE: Any = np.int64(1)
"""Rows of a batch's flow: the base case; one change after another, solved cold."""


class Snapshot(NamedTuple):
    """An operating point: everything on which the flows after any change depend."""

    topo_vect: Annotated[I32, constant("topo", "busbar of each element, -1 when disconnected")]
    last_bus: Annotated[I32, constant("topo", "busbar it is on or was on last, where a line end returns to")]
    cooldown_line: Annotated[I32, constant("line", "before the line may be switched", "steps")]
    cooldown_sub: Annotated[I32, constant("sub", "before the substation may be changed", "steps")]
    gen_p: Annotated[F32, constant("gen", "production", "MW")]
    gen_v: Annotated[F32, constant("gen", "voltage set-point", "per unit of the nominal voltage")]
    load_p: Annotated[F32, constant("load", "demand", "MW")]
    load_q: Annotated[F32, constant("load", "reactive demand", "MVAr")]
    storage_p: Annotated[F32, constant("storage", "positive charges", "MW")]


class Changes(NamedTuple):
    """What is asked; entry by entry."""

    kind: Annotated[I8, constant("change", "NOTHING, MOVE or SWITCH")]
    target: Annotated[I32, constant("change", "substation or line")]
    mask: Annotated[U64, constant("change word", "MOVE: bit k is the k-th element of the substation")]


class ChangeOutcomes(NamedTuple):
    """The flow after each change; entry by entry."""

    worst_loading: Annotated[F32, workspace("change", "largest current over thermal limit; inf where there is no flow")]
    verdict: Annotated[I8, workspace("change", "SOLVED, or why there is no flow, or UNASKED")]
    overloads: Annotated[I32, workspace("change", "lines above their thermal limit")]
    cold: Annotated[Flags, workspace("change", "the cold recipe was asked")]
    rho: Annotated[F32, workspace("wanted line", "by change: loadings, inf where there is no flow; or none")]


class Scratch(NamedTuple):
    """Workspace of flows that are solved alone."""

    topo_vect: Annotated[I32, workspace("topo")]
    current: Annotated[F32, workspace("line", "at the origin", "A")]
    parent: Annotated[I32, workspace("bus", "of a search")]
    fed: Annotated[I32, workspace("bus", "1 where a closed line ends")]


class Batch(NamedTuple):
    """All that compiled code works with, passed on as one handle (:mod:`rl2grid.handles`)."""

    network: Network
    wiring: Wiring
    flow: FlowState
    paths: Paths
    lane_flow: LaneFlow
    site: Site
    switches: Switches
    scratch: Scratch
    snapshot: Snapshot
    changes: Changes
    outcomes: ChangeOutcomes


class BatchSolver:
    """Solves batches in one thread; keeps the workspace.

    Args:
        grid: the grid.
        network: its electrical model.
        wiring: see :func:`new_wiring`.
        snapshot: arrays that hold the operating point whenever :meth:`solve` is called.
    """

    def __init__(self, grid: Grid, network: Network, wiring: Wiring, snapshot: Snapshot) -> None:
        self._handle = Handle(_new_batch(grid, network, wiring, snapshot))

    def solve(self, changes: Handle[Changes], outcomes: Handle[ChangeOutcomes], order: I32) -> None:
        """Solve the flows after the changes ``order``; see :func:`solve_changes`.

        Args:
            changes: the changes.
            outcomes: where the outcomes are written.
            order: as there.
        """
        self._handle.point_at("changes", changes)
        self._handle.point_at("outcomes", outcomes)
        solve_changes(self._handle.address, order)

    def find_safe(self, changes: Handle[Changes], outcomes: Handle[ChangeOutcomes], limit: float, company: I32) -> int:
        """The first change that leaves all lines below a limit, or the least bad; see :func:`find_safe_change`."""
        self._handle.point_at("changes", changes)
        self._handle.point_at("outcomes", outcomes)
        return int(find_safe_change(self._handle.address, limit, company))


def new_snapshot(grid: Grid) -> Snapshot:
    """A blank operating point."""
    return allocate(Snapshot, axis_sizes(grid))


def _new_batch(grid: Grid, network: Network, wiring: Wiring, snapshot: Snapshot) -> Batch:
    """A batch without changes."""
    sizes = axis_sizes(grid)
    n_bus = sizes["bus"]
    return Batch(
        network,
        wiring,
        new_flow_state(network, 2),
        new_paths(n_bus, 2 * n_bus),
        new_lane_flow(n_bus, grid.n_line),
        new_site(n_bus, min(int(grid.sub_info.max()), LARGEST_SITE)),
        new_switches(n_bus),
        allocate(Scratch, sizes),
        snapshot,
        allocate(Changes, {"change": 0, "word": 1}),
        new_outcomes(0, np.zeros((0, 0), np.float32)),
    )


def new_outcomes(n: int, rho: F32) -> ChangeOutcomes:
    """Room for the outcomes of ``n`` changes; ``rho``, float32 [n, line] or [0, line], is written where it lies."""
    return allocate(ChangeOutcomes, {"change": n}, rho=rho)


def new_wiring(grid: Grid, network: Network) -> Wiring:
    """What batched flows read of a grid beside its network."""
    kind, index = np.zeros(grid.dim_topo, np.int32), np.zeros(grid.dim_topo, np.int32)
    groups = (
        (ORIGIN, grid.line_or_pos_topo_vect),
        (EXTREMITY, grid.line_ex_pos_topo_vect),
        (GENERATOR, grid.gen_pos_topo_vect),
        (LOAD, grid.load_pos_topo_vect),
        (STORAGE, grid.storage_pos_topo_vect),
    )
    for name, positions in groups:
        kind[positions] = name
        index[positions] = np.arange(len(positions))
    shunt = np.zeros((grid.n_sub, 2))
    np.add.at(shunt, network.shunt_sub, network.shunt_admittance)
    nominal = network.nominal_voltage[network.line_or_sub]
    ampere = network.base_power[0] / (math.sqrt(3.0) * nominal) * 1000.0
    return Wiring(
        grid.sub_first_element, grid.sub_info, kind, index, shunt, ampere / grid.thermal_limit, grid.thermal_limit
    )


_open_batch = opener(Batch)


@borrowing_jit
def solve_changes(address: int, order: I32) -> None:
    """Solve the flows after some changes.

    Args:
        address: of the handle to a :class:`Batch`.
        order: int32 [k], which changes to solve; moves of one substation in a row. Only their outcomes are written.
    """
    batch = _open_batch(address)
    changes = batch.changes
    has_base = _solve_base(batch)
    begin = 0
    n = order.shape[0]
    while begin < n:
        end = begin + 1
        while end < n and _go_together(changes, order[begin], order[end]):
            end += 1
        _solve_together(batch, has_base, order[begin:end])
        begin = end


@borrowing_jit
def find_safe_change(address: int, limit: float, company: I32) -> int:
    """Find the first change after which every line is loaded below a limit, solving no more than that takes.

    Args:
        address: of the handle to a :class:`Batch`. Outcomes are written of those changes that were solved; of the
            others the verdict is :data:`UNASKED`.
        limit: share of the thermal limits.
        company: workspace, int32 [change].

    Returns:
        The change; if there is none, the first of those with the least worst loading.
    """
    batch = _open_batch(address)
    changes, outcomes = batch.changes, batch.outcomes
    n = changes.kind.shape[0]
    for change in range(n):
        outcomes.verdict[change] = UNASKED
    has_base = _solve_base(batch)
    best = 0
    for change in range(n):
        if outcomes.verdict[change] == UNASKED:
            size = 0
            for other in range(change, n):
                if _go_together(changes, change, other):
                    company[size] = other
                    size += 1
            _solve_together(batch, has_base, company[:size])
        if np.float64(outcomes.worst_loading[change]) < limit:
            return change
        if outcomes.worst_loading[change] < outcomes.worst_loading[best]:
            best = change
    return best


@borrowing_jit
def _solve_base(batch: Batch) -> bool:
    """Solve the base case; whether flows may start from it."""
    flow, snapshot = batch.flow, batch.snapshot
    forget_flow(flow, _BASE)
    status = run_flow(
        batch.network, flow, _BASE, snapshot.topo_vect, snapshot.gen_p, snapshot.gen_v, snapshot.load_p,
        snapshot.load_q, snapshot.storage_p,
    )  # fmt: skip
    return status == CONVERGED and bool(flow.known[_BASE])


@borrowing_jit
def _go_together(changes: Changes, one: Index, other: Index) -> bool:
    """Whether two changes share lanes: moves of one substation, switches of any lines."""
    if changes.kind[one] != changes.kind[other]:
        return False
    return bool(changes.kind[one] != MOVE or changes.target[one] == changes.target[other])


@borrowing_jit
def _solve_together(batch: Batch, has_base: bool, order: I32) -> None:
    """Solve changes of one kind, moves of one substation."""
    flow = batch.flow
    if not has_base:
        for k in range(order.shape[0]):
            _solve_alone(batch, order[k])
        return
    equations = equations_of(flow, _BASE)
    factors = factors_of(flow, _BASE, flow.column[_BASE], flow.panel[_BASE], flow.sparse_row)
    kind = batch.changes.kind[order[0]]
    if kind == NOTHING:
        _repeat_base(batch, order)
    elif kind == SWITCH:
        _solve_switches(batch, equations, factors, order)
    else:
        _solve_moves(batch, equations, factors, order)


@borrowing_jit
def _repeat_base(batch: Batch, order: I32) -> None:
    outcomes = batch.outcomes
    write_currents(batch.network, batch.flow, _BASE, batch.scratch.current)
    for k in range(order.shape[0]):
        outcomes.cold[order[k]] = False
        _write_solution(batch, order[k])


@borrowing_jit
def _write_solution(batch: Batch, change: Index) -> None:
    """The outcome that the currents in the scratch mean."""
    outcomes, rho = batch.outcomes, batch.outcomes.rho
    current, limit = batch.scratch.current, batch.wiring.thermal_limit
    worst = np.float32(0.0)
    overloads = 0
    for line in range(limit.shape[0]):
        loading = current[line] / limit[line]
        worst = max(worst, loading)
        overloads += 1 if loading > np.float32(1.0) else 0
        if rho.shape[0] > 0:
            rho[change, line] = loading
    outcomes.worst_loading[change] = worst
    outcomes.overloads[change] = overloads
    outcomes.verdict[change] = SOLVED


@borrowing_jit
def _write_failure(batch: Batch, change: Index, verdict: int) -> None:
    outcomes, rho = batch.outcomes, batch.outcomes.rho
    outcomes.worst_loading[change] = np.inf
    outcomes.overloads[change] = 0
    outcomes.verdict[change] = verdict
    if rho.shape[0] > 0:
        for line in range(rho.shape[1]):
            rho[change, line] = np.inf


@borrowing_jit
def _solve_alone(batch: Batch, change: Index) -> None:
    """Solve one change by the cold recipe."""
    network, flow, snapshot, scratch = batch.network, batch.flow, batch.snapshot, batch.scratch
    _write_topology(batch, change)
    forget_flow(flow, _ALONE)
    status = run_flow(
        network, flow, _ALONE, scratch.topo_vect, snapshot.gen_p, snapshot.gen_v, snapshot.load_p, snapshot.load_q,
        snapshot.storage_p,
    )  # fmt: skip
    batch.outcomes.cold[change] = True
    if status == CONVERGED:
        write_currents(network, flow, _ALONE, scratch.current)
        _write_solution(batch, change)
        return
    verdict = NO_SOLUTION
    if status == DISCONNECTED:
        verdict = _why_disconnected(batch)
    _write_failure(batch, change, verdict)


@borrowing_jit
def _write_topology(batch: Batch, change: Index) -> None:
    network, snapshot, changes, topo_vect = batch.network, batch.snapshot, batch.changes, batch.scratch.topo_vect
    kind, target = changes.kind[change], changes.target[change]
    for element in range(topo_vect.shape[0]):
        topo_vect[element] = snapshot.topo_vect[element]
    if kind == MOVE:
        first = batch.wiring.sub_first_element[target]
        for k in range(batch.wiring.sub_info[target]):
            moved = (changes.mask[change, k // _WORD_BITS] >> np.uint64(k % _WORD_BITS)) & np.uint64(1) != 0
            if moved and topo_vect[first + k] > 0:
                topo_vect[first + k] = 3 - topo_vect[first + k]
    elif kind == SWITCH:
        origin, extremity = network.line_or_position[target], network.line_ex_position[target]
        if topo_vect[origin] > 0 or topo_vect[extremity] > 0:
            topo_vect[origin] = -1
            topo_vect[extremity] = -1
        else:
            topo_vect[origin] = snapshot.last_bus[origin]
            topo_vect[extremity] = snapshot.last_bus[extremity]


@borrowing_jit
def _bus(topo_vect: I32, position: Index, sub: Index, n_sub: Index) -> Index:
    """Bus of an element, -1 if it is off."""
    busbar = topo_vect[position]
    return -1 if busbar < 1 else np.int64(sub) + (np.int64(busbar) - 1) * n_sub


@borrowing_jit
def _why_disconnected(batch: Batch) -> int:
    """Reason, in the order of a game over's, why the topology in the scratch is in pieces."""
    network, storage_p = batch.network, batch.snapshot.storage_p
    topo_vect, parent, fed = batch.scratch.topo_vect, batch.scratch.parent, batch.scratch.fed
    n_sub = network.nominal_voltage.shape[0]
    for every in range(parent.shape[0]):
        parent[every] = every
        fed[every] = 0
    for line in range(network.line_or_sub.shape[0]):
        origin = _bus(topo_vect, network.line_or_position[line], network.line_or_sub[line], n_sub)
        extremity = _bus(topo_vect, network.line_ex_position[line], network.line_ex_sub[line], n_sub)
        if origin < 0 or extremity < 0:
            continue
        fed[origin] = 1
        fed[extremity] = 1
        parent[_find(parent, origin)] = _find(parent, extremity)
    island = False
    main = _bus(topo_vect, network.gen_position[network.slack_gen[0]], network.gen_sub[network.slack_gen[0]], n_sub)
    for load in range(network.load_sub.shape[0]):
        bus = _bus(topo_vect, network.load_position[load], network.load_sub[load], n_sub)
        if bus < 0 or fed[bus] == 0:
            return LOAD_CUT_OFF
        island |= _find(parent, bus) != _find(parent, max(main, 0))
    for gen in range(network.gen_sub.shape[0]):
        bus = _bus(topo_vect, network.gen_position[gen], network.gen_sub[gen], n_sub)
        if bus < 0 or fed[bus] == 0:
            return GENERATOR_CUT_OFF
        island |= _find(parent, bus) != _find(parent, main)
    for storage in range(network.storage_sub.shape[0]):
        bus = _bus(topo_vect, network.storage_position[storage], network.storage_sub[storage], n_sub)
        if storage_p[storage] != 0.0 and (bus < 0 or fed[bus] == 0):
            return STORAGE_CUT_OFF
        island |= bool(bus >= 0 and _find(parent, max(bus, 0)) != _find(parent, main))
    for every in range(parent.shape[0]):
        island |= bool(fed[every] == 1 and _find(parent, every) != _find(parent, main))
    return ISLAND if island else NO_SOLUTION


@borrowing_jit
def _find(parent: I32, bus: Index) -> Index:
    while parent[bus] != bus:
        parent[bus] = parent[parent[bus]]
        bus = np.int64(parent[bus])
    return bus


@borrowing_jit
def _solve_switches(batch: Batch, equations: Equations, factors: Factors, order: I32) -> None:
    network, wiring, flow, changes = batch.network, batch.wiring, batch.flow, batch.changes
    lane_flow, switches, paths = batch.lane_flow, batch.switches, batch.paths
    fill_jacobian(equations, factors)
    solvable = factorise(factors)
    if solvable:
        for node in range(equations.n_free):
            write_path(factors, node, paths, node)
    for entry in range(equations.admittance_first[equations.n_free + 1]):
        lane_flow.admittance[entry, 0] = equations.admittance[entry, 0]
        lane_flow.admittance[entry, 1] = equations.admittance[entry, 1]
    for node in range(equations.n_free):
        lane_flow.injection[node, 0] = equations.injection[node, 0]
        lane_flow.injection[node, 1] = equations.injection[node, 1]
    lane = np.int64(0)
    for k in range(order.shape[0]):
        change = order[k]
        line = changes.target[change]
        opens = flow.line_or_node[_BASE, line] != ABSENT
        origin: Index = -1
        extremity: Index = -1
        if opens and not is_bridge(flow, _BASE, equations, switches, line):
            origin, extremity = np.int64(flow.line_or_node[_BASE, line]), np.int64(flow.line_ex_node[_BASE, line])
        if not opens:
            origin, extremity = _ends_if_closed(batch, line)
        if not solvable or origin < 0 or extremity < 0 or origin == extremity:
            _solve_alone(batch, change)
            continue
        place_switch(network, flow, _BASE, equations, paths, lane_flow, switches, lane, line, origin, extremity, opens)
        lane_flow.action[lane] = change
        lane += 1
        if lane == WIDTH:
            solve_switches(network, wiring.limit, flow, _BASE, equations, factors, paths, lane_flow, switches)
            _finish_lanes(batch)
            lane = np.int64(0)
    if lane > 0:
        for idle in range(lane, WIDTH):
            lane_flow.state[idle] = EMPTY
        solve_switches(network, wiring.limit, flow, _BASE, equations, factors, paths, lane_flow, switches)
        _finish_lanes(batch)


@borrowing_jit
def _ends_if_closed(batch: Batch, line: Index) -> tuple[Index, Index]:
    """Nodes that an open line joins when it is closed, -1 for a busbar without elements or a half-open line."""
    network, flow, snapshot = batch.network, batch.flow, batch.snapshot
    n_sub = network.nominal_voltage.shape[0]
    origin, extremity = network.line_or_position[line], network.line_ex_position[line]
    if snapshot.topo_vect[origin] > 0 or snapshot.topo_vect[extremity] > 0:
        return -1, -1
    first = _bus(snapshot.last_bus, origin, network.line_or_sub[line], n_sub)
    second = _bus(snapshot.last_bus, extremity, network.line_ex_sub[line], n_sub)
    if first < 0 or second < 0:
        return -1, -1
    a, b = flow.node_of_bus[_BASE, first], flow.node_of_bus[_BASE, second]
    if a == ABSENT or b == ABSENT:
        return -1, -1
    return np.int64(a), np.int64(b)


@borrowing_jit
def _finish_lanes(batch: Batch) -> None:
    """Write what the lanes found; those that failed are solved alone."""
    lane_flow, outcomes, rho = batch.lane_flow, batch.outcomes, batch.outcomes.rho
    dismiss_distant_lanes(lane_flow)
    find_worst(lane_flow)
    loading = lane_flow.loading
    for lane in range(WIDTH):
        if lane_flow.state[lane] == EMPTY:
            continue
        change = lane_flow.action[lane]
        if lane_flow.state[lane] != DONE:
            _solve_alone(batch, change)
            continue
        worst = np.float32(lane_flow.worst[0, lane])
        overloads = 0
        if worst > np.float32(1.0):
            for line in range(loading.shape[0]):
                overloads += 1 if np.float32(math.sqrt(loading[line, lane])) > np.float32(1.0) else 0
        outcomes.worst_loading[change] = worst
        outcomes.overloads[change] = overloads
        outcomes.verdict[change] = SOLVED
        outcomes.cold[change] = False
        if rho.shape[0] > 0:
            for line in range(loading.shape[0]):
                rho[change, line] = math.sqrt(loading[line, lane])


@borrowing_jit
def _solve_moves(batch: Batch, equations: Equations, factors: Factors, order: I32) -> None:
    network, wiring, flow, changes, snapshot = batch.network, batch.wiring, batch.flow, batch.changes, batch.snapshot
    lane_flow, site, paths, outcomes = batch.lane_flow, batch.site, batch.paths, batch.outcomes
    sub = changes.target[order[0]]
    solvable = wiring.sub_info[sub] <= LARGEST_SITE and open_site(
        network, wiring, flow, _BASE, equations, factors, paths, lane_flow, site, sub, snapshot.topo_vect,
        snapshot.gen_p, snapshot.gen_v, snapshot.load_p, snapshot.load_q, snapshot.storage_p,
    )  # fmt: skip
    lane = np.int64(0)
    for k in range(order.shape[0]):
        change = order[k]
        if not solvable:
            _solve_alone(batch, change)
            continue
        second = (site.members[SECOND] ^ np.uint32(changes.mask[change, 0])) & site.members[CONNECTED]
        verdict = _verdict_of_move(site, second)
        if verdict != SOLVED:
            outcomes.cold[change] = False
            _write_failure(batch, change, verdict)
            continue
        place_lane(wiring, site, lane, sub, second)
        lane_flow.state[lane] = RUNNING
        lane_flow.action[lane] = change
        lane += 1
        if lane == WIDTH:
            solve_moves(network, wiring, flow, _BASE, equations, factors, paths, lane_flow, site)
            _finish_lanes(batch)
            lane = np.int64(0)
    if lane > 0:
        for idle in range(lane, WIDTH):
            lane_flow.state[idle] = EMPTY
        solve_moves(network, wiring, flow, _BASE, equations, factors, paths, lane_flow, site)
        _finish_lanes(batch)


@borrowing_jit
def _verdict_of_move(site: Site, second: np.uint32) -> int:
    """Whether the grid holds together with the elements ``second`` on busbar 2; if not, why."""
    members = site.members
    first = members[CONNECTED] & ~second
    lonely = np.uint32(0)
    if first & members[LINES] == 0:
        lonely |= first
    if second & members[LINES] == 0:
        lonely |= second
    if lonely & members[LOADS]:
        return LOAD_CUT_OFF
    if lonely & members[GENERATORS]:
        return GENERATOR_CUT_OFF
    if lonely & members[STORAGES]:
        return STORAGE_CUT_OFF
    if lonely != 0:
        return ISLAND
    if first == 0 and site.counts[HAS_SHUNT] == 1:
        return NO_SOLUTION
    if first != 0 and second != 0 and site.counts[N_PARTS] > 1:
        joined = False
        for part in range(site.counts[N_PARTS]):
            joined |= (site.part[part] & first) != 0 and (site.part[part] & second) != 0
        if not joined:
            return ISLAND
    return NO_SOLUTION if _setpoints_conflict(site, first) or _setpoints_conflict(site, second) else SOLVED


@borrowing_jit
def _setpoints_conflict(site: Site, here: np.uint32) -> bool:
    """Whether generators on one busbar want different voltages."""
    held = here & site.members[GENERATORS]
    lowest, highest = np.inf, -np.inf
    for k in range(site.counts[N_ELEMENTS]):
        if (held >> np.uint32(k)) & np.uint32(1):
            lowest = min(lowest, site.setpoint[k])
            highest = max(highest, site.setpoint[k])
    return highest - lowest > _SETPOINT_TOLERANCE
