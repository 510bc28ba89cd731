"""Flows of several rows of one pattern that go on from their last ones, side by side.

Each lane takes the steps that :func:`rl2grid.powerflow.newton.solve_warm` takes for a row alone, by the same functions
and verdicts, so that the bits of a flow depend neither on the rows beside it nor on whether there are any. What a lane
cannot accept stays as it was, for :func:`rl2grid.powerflow.ac.solve_flow` to decide.
"""

from __future__ import annotations

import numpy as np

from rl2grid.arrays import F32, F64, Index
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.ac import amperes, line_current
from rl2grid.powerflow.factors import ONE, TWO, factorise, solve
from rl2grid.powerflow.flow_lanes import (
    FlowLanes,
    any_marked,
    forget_marks,
    give_up_singular,
    hold_still,
    mark,
    take_new_factors,
)
from rl2grid.powerflow.flow_state import ABSENT, Equations, FlowState, factors_of
from rl2grid.powerflow.lane_flow import DONE, FAILED, RUNNING
from rl2grid.powerflow.lanes import WIDTH, Lanes, at, load, load_columns, store, store_columns
from rl2grid.powerflow.model import Network
from rl2grid.powerflow.newton import (
    ARRIVED,
    STUCK,
    apply_step,
    fill_jacobian,
    is_far,
    judge_warm,
    measure_mismatch,
    write_voltage,
)
from rl2grid.powerflow.topology import is_same_topology


@borrowing_jit
def solve_warm_side_by_side(
    network: Network, flow: FlowState, lanes: FlowLanes, n: int, gen_v: F32 | F64, a_or: F32
) -> None:
    """Solve the flows of the first ``n`` lanes' rows, which were prepared, have one pattern and may go on.

    Lanes end as DONE, voltages and factors of their rows written, or as FAILED, their rows untouched.

    Args:
        network: electrical model of the grid.
        flow: rows of environments.
        lanes: ``row`` says which of them.
        n: how many lanes are used, at most ``WIDTH``.
        gen_v: [row, gen] voltage set-points, per unit.
        a_or: float32 [row, line], written where the lane is DONE: as :func:`rl2grid.powerflow.ac.write_currents`.
    """
    i = lanes.row[0]
    n_free = np.int64(flow.n_node[i]) - 1
    equations = Equations(
        n_free, flow.first_unknown[i], flow.admittance_first[i], flow.admittance_node[i], lanes.admittance,
        flow.admittance_panel[i], lanes.magnitude, lanes.angle, lanes.voltage, lanes.injection, lanes.power, lanes.step,
    )  # fmt: skip
    factors = factors_of(flow, i, flow.column[i], lanes.panel, lanes.sparse_row)
    new_factors = factors_of(flow, i, flow.column[i], lanes.new_panel, lanes.sparse_row)
    n_values = np.int64(flow.first_panel[i, n_free])
    for lane in range(WIDTH):
        lanes.state[lane] = FAILED
        if lane < n:
            _begin(flow, lanes, lane, gen_v[lanes.row[lane]])
    _write_admittance(flow, lanes, n, 2 * np.int64(flow.admittance_first[i, n_free + 1]))
    _gather(flow.panel, lanes, n, n_values, lanes.panel)
    write_voltage(equations)
    store(lanes.mismatch, 0, measure_mismatch(equations))
    n_steps = 0
    while _judge(lanes, n, n_steps, network.tolerance[0]):
        if any_marked(lanes.renews, n):
            fill_jacobian(equations, new_factors)
            store(lanes.sound, 0, factorise(new_factors))
            take_new_factors(lanes, lanes.panel, lanes.new_panel, n_values)
            give_up_singular(lanes, n)
        solve(factors, lanes.step)
        hold_still(lanes, equations)
        apply_step(equations)
        store(lanes.mismatch_before, 0, load(lanes.mismatch, 0))
        store(lanes.mismatch, 0, measure_mismatch(equations))
        n_steps += 1
    _write_currents(network, flow, lanes, n)
    for lane in range(n):
        if lanes.state[lane] == DONE:
            _finish(flow, lanes, lane, a_or[lanes.row[lane]])
    _scatter_factors(flow, lanes, n, n_values)


@borrowing_jit
def _begin(flow: FlowState, lanes: FlowLanes, lane: Index, gen_v: F32 | F64) -> None:
    """Copy a row's last voltages and its injections to a lane, and impose the set-points."""
    i, column = lanes.row[lane], np.uint64(lane)
    magnitude, angle, injection = flow.magnitude[i], flow.angle[i], flow.injection[i]
    for node in range(flow.n_node[i]):
        lanes.magnitude[node, column] = magnitude[node]
        lanes.angle[node, column] = angle[node]
        lanes.injection[node, 0, column] = injection[node, 0]
        lanes.injection[node, 1, column] = injection[node, 1]
    gen_node = flow.gen_node[i]
    for gen in range(gen_node.shape[0]):
        lanes.magnitude[gen_node[gen], column] = gen_v[gen]
    lanes.state[lane] = RUNNING
    lanes.renewed[lane] = False


@borrowing_jit
def _write_admittance(flow: FlowState, lanes: FlowLanes, n: Index, n_values: Index) -> None:
    """Copy the admittance matrices of all rows to their lanes, of which there is often but one."""
    topology, differ = flow.topo_vect[lanes.row[0]], False
    for lane in range(1, n):
        differ |= not is_same_topology(topology, flow.topo_vect[lanes.row[lane]])
    if differ:
        _gather(flow.admittance, lanes, n, n_values, lanes.admittance)
        return
    values = flow.admittance[lanes.row[0]]
    for k in range(n_values):
        store(lanes.admittance, k, at(values, k))


@borrowing_jit
def _gather(values: F64, lanes: FlowLanes, n: Index, n_values: Index, array: Lanes) -> None:
    """Copy the first values of all rows to their lanes."""
    whole = n_values - n_values % WIDTH if n == WIDTH else 0
    for k in range(0, whole, WIDTH):
        load_columns(values, lanes.row, k, array)
    flat = array.reshape(-1, WIDTH)
    for lane in range(n):
        own, column = values[lanes.row[lane]].reshape(-1), np.uint64(lane)
        for k in range(whole, n_values):
            flat[k, column] = own[k]


@borrowing_jit
def _scatter_factors(flow: FlowState, lanes: FlowLanes, n: Index, n_values: Index) -> None:
    """Copy new factors of lanes that are done to their rows."""
    n_changed = 0
    for lane in range(n):
        n_changed += lanes.state[lane] == DONE and lanes.renewed[lane]
    whole = n_values - n_values % WIDTH if n_changed == WIDTH else 0
    for k in range(0, whole, WIDTH):
        store_columns(flow.panel, lanes.row, k, lanes.panel)
    for lane in range(n):
        if lanes.state[lane] != DONE or not lanes.renewed[lane]:
            continue
        panel, column = flow.panel[lanes.row[lane]], np.uint64(lane)
        for k in range(whole, n_values):
            panel[k] = lanes.panel[k, column]


@borrowing_jit
def _judge(lanes: FlowLanes, n: Index, n_steps: int, tolerance: float) -> bool:
    """Decide which lanes take another step, and which of them with new factors; whether any does."""
    forget_marks(lanes)
    for lane in range(n):
        if lanes.state[lane] != RUNNING:
            continue
        mismatch = lanes.mismatch[0, lane]
        ratio = mismatch / lanes.mismatch_before[0, lane] if n_steps > 0 else 0.0
        verdict = judge_warm(n_steps, mismatch, ratio, tolerance)
        if verdict == ARRIVED:
            lanes.state[lane] = DONE
        elif verdict == STUCK:
            lanes.state[lane] = FAILED
        else:
            mark(lanes, lane, verdict)
    return any_marked(lanes.active, n)


@borrowing_jit
def _write_currents(network: Network, flow: FlowState, lanes: FlowLanes, n: Index) -> None:
    """Currents of lines that are closed in any row, in all lanes."""
    voltage = lanes.voltage
    for line in range(flow.line_or_node.shape[1]):
        lane = 0
        while lane < n and flow.line_or_node[lanes.row[lane], line] == ABSENT:
            lane += 1
        if lane == n:
            continue
        i = lanes.row[lane]
        origin, extremity = TWO * flow.line_or_node[i, line], TWO * flow.line_ex_node[i, line]
        current = line_current(
            network, line, load(voltage, origin), load(voltage, origin + ONE), load(voltage, extremity),
            load(voltage, extremity + ONE),
        )  # fmt: skip
        store(lanes.current, line, current)


@borrowing_jit
def _finish(flow: FlowState, lanes: FlowLanes, lane: Index, a_or: F32) -> None:
    """Copy the voltages that a lane has found to its row, unless they are far from what the cold recipe found last."""
    i, column = lanes.row[lane], np.uint64(lane)
    magnitude, angle, voltage, anchor = flow.magnitude[i], flow.angle[i], flow.voltage[i], flow.anchor[i]
    far = False
    for node in range(flow.n_node[i]):
        far |= is_far(lanes.magnitude[node, column], lanes.angle[node, column], anchor[node, 0], anchor[node, 1])
    if far:
        lanes.state[lane] = FAILED
        return
    for node in range(flow.n_node[i]):
        magnitude[node] = lanes.magnitude[node, column]
        angle[node] = lanes.angle[node, column]
        voltage[node, 0] = lanes.voltage[node, 0, column]
        voltage[node, 1] = lanes.voltage[node, 1, column]
    origins = flow.line_or_node[i]
    for line in range(a_or.shape[0]):
        a_or[line] = np.float32(0.0) if origins[line] == ABSENT else amperes(lanes.current[line, column])
