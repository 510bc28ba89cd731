"""Flows of several rows that begin anew, side by side, whatever their topologies.

The lanes have the nodes that any of their rows has (a *union*), numbered in the order of elimination, as the nodes of
each row are. What a row lacks is there in its lane all the same: a node with an equation of its own, solved by nothing,
or a magnitude that a generator holds. Such equations add nothing but exact zeros to those of the row, so that each lane
takes the steps that :func:`rl2grid.powerflow.newton.solve_cold` takes for a row alone, to the last bit but the sign of
a zero. Flows that need more steps than most others finish alone.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from rl2grid.arrays import F32, F64, I32, U16, U32, U64, Flags, Index
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.ac import finish_cold, write_currents
from rl2grid.powerflow.bits import count_bits
from rl2grid.powerflow.factors import ONE, THREE, factorise, solve
from rl2grid.powerflow.flow_lanes import (
    LOST,
    FlowLanes,
    any_marked,
    forget_marks,
    give_up_singular,
    hold_still,
    mark,
    take_new_factors,
)
from rl2grid.powerflow.flow_state import ABSENT, Equations, Factors, FlowState
from rl2grid.powerflow.lane_flow import DONE, FAILED, RUNNING
from rl2grid.powerflow.lanes import WIDTH, Lanes, larger, load, magnitude, splat, store, where_less
from rl2grid.powerflow.model import Network
from rl2grid.powerflow.newton import (
    ARRIVED,
    STUCK,
    apply_step,
    fill_jacobian,
    judge_cold,
    measure_mismatch,
    write_voltage,
)
from rl2grid.powerflow.topology import (
    ADJACENT,
    ends_on_first,
    insert,
    join_themselves,
    measure_fill,
    write_entries,
    write_fill,
)
from rl2grid.structures import allocate, workspace

_NO_ROOM = -1
_FEW = 2
"""Lanes that are not worth a step of all: eight take three to four times as long as one."""
_LIKENESS = 8
"""Patterns are alike if at most one in so many elements is elsewhere: the fill of a union grows with what its rows
have not in common."""
_SMALLEST = 1e-13
"""A lane whose pivot is this much smaller than what was there before it is left to the row alone, which gives up a
little later."""


class Union(NamedTuple):
    """The nodes of the rows of all lanes; what is not explained is as in ``FlowState``."""

    node: Annotated[U16, workspace("lane bus", "of the union, by node of the lane's row")]
    entry: Annotated[U16, workspace("lane entry", "of the union, by entry of the admittance matrix of the lane's row")]
    exists: Annotated[Lanes, workspace("bus lane", "1.0 where the row has the node")]
    varies: Annotated[Lanes, workspace("bus lane", "1.0 where the magnitude is an unknown")]
    differs: Annotated[Flags, workspace("bus", "rows lack the node, or have fewer unknowns there than others")]
    pivot: Annotated[Lanes, workspace("bus lane", "before it is eliminated, of nodes that differ")]

    first_unknown: Annotated[U16, workspace("pointer")]
    node_of_unknown: Annotated[U16, workspace("unknown")]
    admittance_first: Annotated[U16, workspace("pointer")]
    admittance_node: Annotated[U16, workspace("pair")]
    admittance: Annotated[Lanes, workspace("pair 2 lane")]
    admittance_panel: Annotated[U32, workspace("pair")]
    diagonal_entry: Annotated[U16, workspace("bus")]
    first_column: Annotated[U32, workspace("pointer")]
    own_column: Annotated[U32, workspace("bus")]
    first_panel: Annotated[U32, workspace("pointer")]
    own_panel: Annotated[U32, workspace("bus")]
    column: Annotated[U16, workspace("column")]


def new_union(flow: FlowState) -> Union:
    """Room for the union of rows of ``flow``."""
    entries = flow.admittance_node.shape[1]
    sizes = {
        "lane": WIDTH,
        "bus": flow.magnitude.shape[1],
        "pointer": flow.first_unknown.shape[1],
        "unknown": len(flow.step),
        "entry": entries,
        "pair": min(2 * entries, ABSENT),
        "column": 2 * flow.column.shape[1],
    }
    return allocate(Union, sizes)


@borrowing_jit
def is_like(pattern: I32, other: I32) -> bool:
    """Whether two patterns differ so little that their union is worth it."""
    n_different = 0
    for k in range(pattern.shape[0]):
        n_different += pattern[k] != other[k]
    return bool(n_different * _LIKENESS <= pattern.shape[0])


@borrowing_jit
def solve_cold_side_by_side(
    network: Network, flow: FlowState, lanes: FlowLanes, union: Union, n: int, gen_v: F32 | F64, a_or: F32
) -> None:
    """Solve the flows of the first ``n`` lanes' rows, which were prepared, by LightSim2Grid's recipe.

    Lanes end as DONE, voltages and factors of their rows written; as LOST, where these diverge; or as FAILED, their
    rows untouched, for :func:`rl2grid.powerflow.ac.solve_flow` to solve.

    Args:
        network: electrical model of the grid.
        flow: rows of environments.
        lanes: ``row`` says which of them; their slack generators are on the same bus.
        union: is overwritten.
        n: how many lanes are used, at most ``WIDTH``.
        gen_v: [row, gen] voltage set-points, per unit.
        a_or: float32 [row, line], written where the lane is DONE: as :func:`rl2grid.powerflow.ac.write_currents`.
    """
    for lane in range(WIDTH):
        lanes.state[lane] = FAILED
    n_free = _unite(network, flow, lanes, union, n)
    if n_free == _NO_ROOM:
        return
    equations = Equations(
        n_free, union.first_unknown, union.admittance_first, union.admittance_node, union.admittance,
        union.admittance_panel, lanes.magnitude, lanes.angle, lanes.voltage, lanes.injection, lanes.power, lanes.step,
    )  # fmt: skip
    factors = _factors_of(union, n_free, lanes, lanes.panel)
    new_factors = _factors_of(union, n_free, lanes, lanes.new_panel)
    n_values = np.int64(union.first_panel[n_free])
    _begin(flow, lanes, union, n, n_free, gen_v)
    _fill_dc(network, flow, lanes, union, n, n_free)
    _factorise(lanes, union, factors)
    give_up_singular(lanes, n)
    solve(factors, lanes.step)
    for node in range(n_free):
        store(lanes.angle, node, load(lanes.step, union.first_unknown[node]))
    store(lanes.angle, n_free, splat(0.0))
    write_voltage(equations)
    _measure_mismatch(lanes, union, equations)
    n_steps = 0
    while _judge(network, flow, lanes, union, factors.panel, n, n_steps) > 0:
        if any_marked(lanes.renews, n):
            fill_jacobian(equations, new_factors)
            _hold_back(union, equations, new_factors.panel)
            _factorise(lanes, union, new_factors)
            if _all_renew(lanes, n):
                factors, new_factors = new_factors, factors
            else:
                take_new_factors(lanes, factors.panel, new_factors.panel, n_values)
            give_up_singular(lanes, n)
        solve(factors, lanes.step)
        hold_still(lanes, equations)
        apply_step(equations)
        store(lanes.mismatch_before, 0, load(lanes.mismatch, 0))
        _measure_mismatch(lanes, union, equations)
        n_steps += 1
    for lane in range(n):
        if lanes.state[lane] == DONE:
            write_currents(network, flow, lanes.row[lane], a_or[lanes.row[lane]])


@borrowing_jit
def _factors_of(union: Union, n_free: np.int64, lanes: FlowLanes, panel: Lanes) -> Factors:
    """Factors with the values ``panel`` and the topology of the union."""
    return Factors(
        n_free,
        union.first_unknown,
        union.node_of_unknown,
        union.first_column,
        union.own_column,
        union.first_panel,
        union.own_panel,
        union.column,
        panel,
        lanes.sparse_row,
    )


@borrowing_jit
def _unite(network: Network, flow: FlowState, lanes: FlowLanes, union: Union, n: int) -> np.int64:
    """Write the nodes and matrices of the union; how many nodes it has but the slack's, or ``_NO_ROOM``."""
    n_free = _number_nodes(network, flow, lanes, union, n)
    adjacent = flow.sets[ADJACENT]
    join_themselves(n_free + 1, adjacent)
    _join_nodes(network, flow, lanes, union, n, adjacent)
    if _count_pairs(n_free + 1, adjacent) > union.admittance_node.shape[0]:
        return np.int64(_NO_ROOM)
    n_entries = write_entries(n_free + 1, adjacent, union.admittance_first, union.admittance_node, union.diagonal_entry)
    _write_admittance(flow, lanes, union, n, n_entries)
    columns, values = measure_fill(n_free, union.first_unknown, flow.sets, union.first_column, union.first_panel)
    if columns > union.column.shape[0] or values > lanes.panel.shape[0]:
        return np.int64(_NO_ROOM)
    write_fill(
        n_free, union.first_unknown, flow.sets, union.first_column, union.own_column, union.first_panel,
        union.own_panel, union.admittance_first, union.admittance_node, union.admittance_panel, union.column,
    )  # fmt: skip
    return n_free


@borrowing_jit
def _number_nodes(network: Network, flow: FlowState, lanes: FlowLanes, union: Union, n: int) -> np.int64:
    """Number the buses that any row uses, in the order in which each row numbers its own."""
    node = np.int64(0)
    unknown = 0
    for k in range(flow.order.shape[0]):
        bus = np.uint16(flow.order[k])
        size = 0
        for lane in range(n):
            size = max(size, _unknowns_of(flow, lanes.row[lane], flow.node_of_bus[lanes.row[lane], bus]))
        if size == 0:
            continue
        store(union.exists, node, splat(0.0))
        store(union.varies, node, splat(0.0))
        differs = False
        for lane in range(n):
            own = flow.node_of_bus[lanes.row[lane], bus]
            own_size = _unknowns_of(flow, lanes.row[lane], own)
            differs |= own_size != size
            if own_size > 0:
                union.node[lane, own] = node
                union.exists[node, lane] = 1.0
                union.varies[node, lane] = 1.0 if own_size == 2 else 0.0
        union.differs[node] = differs
        union.first_unknown[node] = unknown
        for _ in range(size):
            union.node_of_unknown[unknown] = node
            unknown += 1
        node += 1
    union.first_unknown[node] = unknown
    union.differs[node] = False
    for lane in range(n):
        union.node[lane, flow.n_node[lanes.row[lane]] - 1] = node
    return node


@borrowing_jit
def _unknowns_of(flow: FlowState, i: Index, node: Index) -> int:
    """How many unknowns a node of row ``i`` has: none if it is absent, or the slack's."""
    if node == ABSENT or node == flow.n_node[i] - 1:
        return 0
    return int(flow.first_unknown[i, node + 1]) - int(flow.first_unknown[i, node])


@borrowing_jit
def _join_nodes(network: Network, flow: FlowState, lanes: FlowLanes, union: Union, n: int, adjacent: U64) -> None:
    """Join the ends of the lines of all rows, of open ones where the rows have room for them."""
    first_or, first_ex = flow.line_or_node[lanes.row[0]], flow.line_ex_node[lanes.row[0]]
    for lane in range(n):
        line_or, line_ex = flow.line_or_node[lanes.row[lane]], flow.line_ex_node[lanes.row[lane]]
        for line in range(line_or.shape[0]):
            own_or, own_ex = line_or[line], line_ex[line]
            if own_or == ABSENT:
                own_or, own_ex = ends_on_first(network, flow, lanes.row[lane], line)
                if own_or == ABSENT or own_ex == ABSENT:
                    continue
            origin, extremity = union.node[lane, own_or], union.node[lane, own_ex]
            if (
                lane > 0
                and first_or[line] != ABSENT
                and origin == union.node[0, first_or[line]]
                and extremity == union.node[0, first_ex[line]]
            ):
                continue
            insert(adjacent, origin, extremity)
            insert(adjacent, extremity, origin)


@borrowing_jit
def _count_pairs(n_node: Index, adjacent: U64) -> np.int64:
    """How many entries an admittance matrix has."""
    pairs = np.int64(0)
    for node in range(n_node):
        for word in range(adjacent.shape[1]):
            pairs += count_bits(adjacent[node, word])
    return pairs


@borrowing_jit
def _write_admittance(flow: FlowState, lanes: FlowLanes, union: Union, n: int, n_entries: Index) -> None:
    """Copy the admittance matrices of all rows to their lanes."""
    for k in range(2 * n_entries):
        store(union.admittance, k, splat(0.0))
    for lane in range(n):
        i, column = lanes.row[lane], np.uint64(lane)
        first, columns, values = flow.admittance_first[i], flow.admittance_node[i], flow.admittance[i]
        for own in range(flow.n_node[i]):
            at = np.uint64(union.admittance_first[union.node[lane, own]])
            for entry in range(first[own], first[own + 1]):
                other = union.node[lane, columns[entry]]
                while union.admittance_node[at] != other:
                    at += ONE
                union.entry[lane, entry] = at
                union.admittance[at, 0, column] = values[entry, 0]
                union.admittance[at, 1, column] = values[entry, 1]


@borrowing_jit
def _begin(flow: FlowState, lanes: FlowLanes, union: Union, n: int, n_free: np.int64, gen_v: F32 | F64) -> None:
    """Write the injections and the magnitudes of a cold start to the lanes."""
    for node in range(n_free + 1):
        store(lanes.magnitude, node, splat(1.0))
        store(lanes.injection, 2 * node, splat(0.0))
        store(lanes.injection, 2 * node + 1, splat(0.0))
    for lane in range(n):
        i, column = lanes.row[lane], np.uint64(lane)
        nodes, injection, gen_node, setpoint = union.node[lane], flow.injection[i], flow.gen_node[i], gen_v[i]
        for own in range(flow.n_node[i]):
            lanes.injection[nodes[own], 0, column] = injection[own, 0]
            lanes.injection[nodes[own], 1, column] = injection[own, 1]
        for gen in range(gen_node.shape[0]):
            lanes.magnitude[nodes[gen_node[gen]], column] = setpoint[gen]
        lanes.state[lane] = RUNNING
        lanes.renews[0, lane] = 1.0


@borrowing_jit
def _fill_dc(network: Network, flow: FlowState, lanes: FlowLanes, union: Union, n: int, n_free: np.int64) -> None:
    """As :func:`rl2grid.powerflow.newton.fill_dc`; what a row lacks keeps still."""
    first_unknown, block, panel, step = union.first_unknown, union.admittance_panel, lanes.panel, lanes.step
    for k in range(union.first_panel[n_free]):
        store(panel, k, splat(0.0))
    for node in range(n_free):
        own = np.uint64(block[union.diagonal_entry[node]])
        unknown = np.uint64(first_unknown[node])
        store(panel, own, splat(1.0) - load(union.exists, node))
        store(step, unknown, load(lanes.injection, 2 * node))
        if first_unknown[node + 1] - first_unknown[node] == 2:
            store(panel, own + THREE, splat(1.0))
            store(step, unknown + ONE, splat(0.0))
    for lane in range(n):
        i, column = lanes.row[lane], np.uint64(lane)
        own_free = np.int64(flow.n_node[i]) - 1
        diagonal, entries = flow.diagonal_entry[i], union.entry[lane]
        for shunt in range(network.shunt_sub.shape[0]):
            own = flow.node_of_bus[i, network.shunt_sub[shunt]]
            if own < own_free:
                step[first_unknown[union.node[lane, own]], column] -= network.shunt_admittance[shunt, 0]
        line_or, line_ex, line_entry = flow.line_or_node[i], flow.line_ex_node[i], flow.line_entry[i]
        for line in range(line_or.shape[0]):
            origin, extremity = line_or[line], line_ex[line]
            if origin == ABSENT:
                continue
            susceptance = network.line_susceptance[line]
            if origin < own_free:
                panel[block[entries[diagonal[origin]]], column] += susceptance
                if extremity < own_free:
                    panel[block[entries[line_entry[line, 0]]], column] -= susceptance
            if extremity < own_free:
                panel[block[entries[diagonal[extremity]]], column] += susceptance
                if origin < own_free:
                    panel[block[entries[line_entry[line, 1]]], column] -= susceptance


@borrowing_jit
def _hold_back(union: Union, equations: Equations, panel: Lanes) -> None:
    """Take out of the Jacobian the magnitudes that generators hold, and give absent nodes equations."""
    first, column, block = equations.admittance_first, equations.admittance_node, equations.admittance_panel
    first_unknown, n_free = equations.first_unknown, equations.n_free
    for node in range(n_free):
        is_pair = first_unknown[node + 1] - first_unknown[node] == 2
        for entry in range(first[node], first[node + 1]):
            other = column[entry]
            if other >= n_free or not (union.differs[node] or union.differs[other]):
                continue
            at = np.uint64(block[entry])
            here, there = load(union.varies, node), load(union.varies, other)
            if first_unknown[other + ONE] - first_unknown[other] == 2:
                magnitude_at = at + (np.uint64(2) if is_pair else ONE)
                store(panel, magnitude_at, load(panel, magnitude_at) * there)
                if is_pair:
                    store(panel, at + THREE, load(panel, at + THREE) * there * here)
            if is_pair:
                store(panel, at + ONE, load(panel, at + ONE) * here)
            if other == node:
                store(panel, at, load(panel, at) + (splat(1.0) - load(union.exists, node)))
                if is_pair:
                    store(panel, at + THREE, load(panel, at + THREE) + (splat(1.0) - here))


@borrowing_jit
def _factorise(lanes: FlowLanes, union: Union, factors: Factors) -> None:
    """Factorise, and mark as not sound what a row alone might find singular."""
    first_unknown, own_panel, panel = factors.first_unknown, factors.own_panel, factors.panel
    for node in range(factors.n_free):
        if union.differs[node]:
            store(union.pivot, node, magnitude(load(panel, own_panel[node])))
    sound = factorise(factors)
    for node in range(factors.n_free):
        if union.differs[node] and first_unknown[node + 1] - first_unknown[node] == 2:
            # Alone, it may be one equation, whose pivot is measured by what was there before.
            shrunk = load(union.pivot, node) * magnitude(load(panel, own_panel[node])) * _SMALLEST
            sound = where_less(shrunk, 1.0, sound, 0.0)
    store(lanes.sound, 0, sound)


@borrowing_jit
def _measure_mismatch(lanes: FlowLanes, union: Union, equations: Equations) -> None:
    """Measure the mismatch of all equations but those of reactive power where a generator holds the voltage."""
    measure_mismatch(equations)
    first_unknown, step = equations.first_unknown, lanes.step
    worst, spoiled = splat(0.0), splat(0.0)
    for node in range(equations.n_free):
        unknown = np.uint64(first_unknown[node])
        difference = load(step, unknown)
        worst = larger(worst, magnitude(difference))
        spoiled += 0.0 * difference
        if first_unknown[node + 1] - first_unknown[node] == 2:
            difference = load(step, unknown + ONE) * load(union.varies, node)
            store(step, unknown + ONE, difference)
            worst = larger(worst, magnitude(difference))
            spoiled += 0.0 * difference
    store(lanes.mismatch, 0, worst + spoiled)


@borrowing_jit
def _judge(
    network: Network, flow: FlowState, lanes: FlowLanes, union: Union, panel: Lanes, n: int, n_steps: int
) -> int:
    """Decide which lanes take another step, and which of them with new factors, and end the others; how many do."""
    n_active = 0
    forget_marks(lanes)
    for lane in range(n):
        if lanes.state[lane] != RUNNING:
            continue
        ratio = _ratio(lanes, lane, n_steps)
        verdict = judge_cold(n_steps, lanes.mismatch[0, lane], ratio, network.tolerance[0], network.max_iterations[0])
        if verdict in (ARRIVED, STUCK):
            _finish(network, flow, lanes, union, panel, lane, n_steps)
        else:
            mark(lanes, lane, verdict)
            n_active += 1
    if n_active > _FEW:
        return n_active
    for lane in range(n):
        if lanes.active[0, lane] > 0.0:
            _finish(network, flow, lanes, union, panel, lane, n_steps)
    return 0


@borrowing_jit
def _ratio(lanes: FlowLanes, lane: Index, n_steps: int) -> float:
    """Of a lane's mismatch to that before its last step."""
    return lanes.mismatch[0, lane] / lanes.mismatch_before[0, lane] if n_steps > 0 else math.inf


@borrowing_jit
def _all_renew(lanes: FlowLanes, n: int) -> bool:
    """Whether no lane goes on with the factors that it has."""
    keeps = False
    for lane in range(n):
        keeps |= lanes.active[0, lane] > lanes.renews[0, lane]
    return not keeps


@borrowing_jit
def _finish(
    network: Network, flow: FlowState, lanes: FlowLanes, union: Union, panel: Lanes, lane: Index, n_steps: int
) -> None:
    """Copy to its row what a lane has come to, voltages and factors; the row does the rest."""
    i, column = lanes.row[lane], np.uint64(lane)
    nodes, voltage = union.node[lane], flow.voltage[i]
    for own in range(flow.n_node[i]):
        node = nodes[own]
        flow.magnitude[i, own] = lanes.magnitude[node, column]
        flow.angle[i, own] = lanes.angle[node, column]
        voltage[own, 0] = lanes.voltage[node, 0, column]
        voltage[own, 1] = lanes.voltage[node, 1, column]
    _copy_factors(flow, union, panel, i, nodes, column)
    lanes.state[lane] = DONE if finish_cold(network, flow, i, n_steps, _ratio(lanes, lane, n_steps)) else LOST


@borrowing_jit
def _copy_factors(flow: FlowState, union: Union, panel: Lanes, i: Index, nodes: U16, lane: np.uint64) -> None:
    """Copy what a lane's row has of the factors to it."""
    first_unknown, node_of_unknown = flow.first_unknown[i], flow.node_of_unknown[i]
    own_panel, at = flow.panel[i], np.uint64(0)
    for own in range(flow.n_node[i] - 1):
        node = nodes[own]
        from_column = np.uint64(union.first_column[node])
        step = np.uint64(union.first_unknown[node + ONE] - union.first_unknown[node])
        is_pair = first_unknown[own + 1] - first_unknown[own] == 2
        for q in range(flow.first_column[i, own], flow.first_column[i, own + 1]):
            unknown = flow.column[i, q]
            other = node_of_unknown[unknown]
            wanted = union.first_unknown[nodes[other]] + (unknown - first_unknown[other])
            while union.column[from_column] != wanted:
                from_column += ONE
            place = np.uint64(union.first_panel[node]) + (from_column - np.uint64(union.first_column[node])) * step
            own_panel[at] = panel[place, lane]
            at += ONE
            if is_pair:
                own_panel[at] = panel[place + ONE, lane]
                at += ONE
