"""Batched flows after one line each is opened or closed.

The Jacobian changes by a matrix of rank four at most, in the rows and columns of the line's ends (Woodbury's formula).
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from rl2grid.arrays import F64, I32, Index
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.flow_state import ABSENT, Equations, Factors, FlowState
from rl2grid.powerflow.lane_flow import (
    RUNNING,
    LaneFlow,
    any_lane_runs,
    begin_lanes,
    judge_lanes,
    measure_distance,
    measure_lanes,
    square_step,
    step_lanes,
    write_loadings,
)
from rl2grid.powerflow.lanes import WIDTH, root, store
from rl2grid.powerflow.model import Network
from rl2grid.powerflow.paths import Paths, solve_backward, solve_forward, write_path_product
from rl2grid.powerflow.topology import is_joined
from rl2grid.structures import allocate, workspace


class Switches(NamedTuple):
    """The line of each lane, and how the Jacobian answers."""

    line: Annotated[I32, workspace("lane")]
    node: Annotated[I32, workspace("lane 2", "of its origin and of its extremity")]
    sign: Annotated[F64, workspace("lane", "1.0 if it is opened, -1.0 if it is closed")]
    gain: Annotated[
        F64, workspace("lane 4 4", "from the ends' answer in the base case to the change of the right-hand side")
    ]
    change: Annotated[F64, workspace("4 4", "derivatives of the line's power")]
    response: Annotated[F64, workspace("4 4", "block of the inverse between the ends")]
    system: Annotated[F64, workspace("4 8", "equations of the gain")]
    block: Annotated[F64, workspace("2 2", "block of an inverse")]
    answer: Annotated[F64, workspace("4", "of the ends")]
    seen: Annotated[I32, workspace("bus", "by node; of searches")]
    queue: Annotated[I32, workspace("bus", "of searches")]


def new_switches(n_bus: int) -> Switches:
    """Blank lanes."""
    return allocate(Switches, {"bus": n_bus, "lane": WIDTH})


@borrowing_jit
def place_switch(
    network: Network, flow: FlowState, i: Index, equations: Equations, paths: Paths, lane_flow: LaneFlow,
    switches: Switches, lane: Index, line: Index, origin: Index, extremity: Index, opens: bool,
) -> None:  # fmt: skip
    """Let a lane open or close a line between two nodes."""
    switches.line[lane] = line
    switches.node[lane, 0] = origin
    switches.node[lane, 1] = extremity
    switches.sign[lane] = 1.0 if opens else -1.0
    lane_flow.state[lane] = RUNNING
    _write_change(network, equations, switches, lane)
    response, block = switches.response, switches.block
    for a in range(2):
        for b in range(2):
            if switches.node[lane, a] >= equations.n_free or switches.node[lane, b] >= equations.n_free:
                block[0, 0] = block[0, 1] = block[1, 0] = block[1, 1] = 0.0
            else:
                write_path_product(paths, switches.node[lane, a], switches.node[lane, b], block)
            for p in range(2):
                for q in range(2):
                    response[2 * a + p, 2 * b + q] = block[p, q]
    _write_gain(switches, lane)


@borrowing_jit
def _write_change(network: Network, equations: Equations, switches: Switches, lane: Index) -> None:
    """Derivatives of the power that the line takes from its ends; rows P, Q and columns angle, magnitude of each."""
    y, voltage, change = network.line_admittance[switches.line[lane]], equations.voltage, switches.change
    for end in range(2):
        here, there = switches.node[lane, end], switches.node[lane, 1 - end]
        own, other = 6 * end, 2 + 2 * end
        e, f = voltage[here, 0], voltage[here, 1]
        square = e * e + f * f
        p_own, q_own = square * y[own], -square * y[own + 1]
        real = y[other] * voltage[there, 0] - y[other + 1] * voltage[there, 1]
        imaginary = y[other] * voltage[there, 1] + y[other + 1] * voltage[there, 0]
        p, q = e * real + f * imaginary, f * real - e * imaginary
        row, across = 2 * end, 2 * (1 - end)
        change[row, row] = -q
        change[row, row + 1] = 2.0 * p_own + p
        change[row + 1, row] = p
        change[row + 1, row + 1] = 2.0 * q_own + q
        change[row, across] = q
        change[row, across + 1] = p
        change[row + 1, across] = -p
        change[row + 1, across + 1] = q
    for row in range(4):
        for column in range(4):
            change[row, column] *= switches.sign[lane]


@borrowing_jit
def _write_gain(switches: Switches, lane: Index) -> None:
    """``change (1 - response change)^-1``; not a number if the line cannot be switched that way."""
    change, response, system = switches.change, switches.response, switches.system
    for row in range(4):
        for column in range(4):
            total = 0.0
            for k in range(4):
                total += response[row, k] * change[k, column]
            system[row, column] = (1.0 if row == column else 0.0) - total
            system[row, 4 + column] = 1.0 if row == column else 0.0
    for pivot in range(4):
        best = pivot
        for row in range(pivot + 1, 4):
            if abs(system[row, pivot]) > abs(system[best, pivot]):
                best = row
        for column in range(8):
            kept = system[pivot, column]
            system[pivot, column] = system[best, column]
            system[best, column] = kept
        scale = 1.0 / system[pivot, pivot]
        for column in range(8):
            system[pivot, column] *= scale
        for row in range(4):
            if row == pivot:
                continue
            factor = system[row, pivot]
            for column in range(8):
                system[row, column] -= factor * system[pivot, column]
    for row in range(4):
        for column in range(4):
            total = 0.0
            for k in range(4):
                total += change[row, k] * system[k, 4 + column]
            switches.gain[lane, row, column] = total


@borrowing_jit
def solve_switches(
    network: Network, limit: F64, flow: FlowState, i: Index, equations: Equations, factors: Factors, paths: Paths,
    lane_flow: LaneFlow, switches: Switches,
) -> None:  # fmt: skip
    """Solve the flows of all lanes and write their squared loadings."""
    begin_lanes(lane_flow, equations)
    _measure_lines(network, equations, lane_flow, switches)
    store(lane_flow.norm, 0, root(square_step(lane_flow, equations)))
    n_steps = 0
    while judge_lanes(lane_flow, n_steps, network.base_power[0]):
        solve_forward(factors, factors.panel, lane_flow.step)
        _correct(equations, paths, lane_flow, switches)
        solve_backward(factors, factors.panel, lane_flow.step)
        step_lanes(lane_flow, equations)
        n_steps += 1
        if any_lane_runs(lane_flow):
            measure_lanes(lane_flow, equations)
            _measure_lines(network, equations, lane_flow, switches)
            store(lane_flow.norm, 0, root(square_step(lane_flow, equations)))
    measure_distance(lane_flow, equations)
    write_loadings(network, flow, i, limit, lane_flow)
    _write_loadings_here(network, limit, lane_flow, switches)


@borrowing_jit
def _measure_lines(network: Network, equations: Equations, lane_flow: LaneFlow, switches: Switches) -> None:
    """Take the power of each lane's line from the mismatch of its ends, or add it."""
    voltage, first_unknown = lane_flow.voltage, equations.first_unknown
    for lane in range(WIDTH):
        if lane_flow.state[lane] != RUNNING:
            continue
        y = network.line_admittance[switches.line[lane]]
        for end in range(2):
            here, there = switches.node[lane, end], switches.node[lane, 1 - end]
            if here >= equations.n_free:
                continue
            own, other = 6 * end, 2 + 2 * end
            e, f = voltage[here, 0, lane], voltage[here, 1, lane]
            e2, f2 = voltage[there, 0, lane], voltage[there, 1, lane]
            real = y[own] * e - y[own + 1] * f + y[other] * e2 - y[other + 1] * f2
            imaginary = y[own] * f + y[own + 1] * e + y[other] * f2 + y[other + 1] * e2
            unknown = np.int64(first_unknown[here])
            lane_flow.step[unknown, lane] -= switches.sign[lane] * (e * real + f * imaginary)
            if np.int64(first_unknown[here + 1]) - unknown == 2:
                lane_flow.step[unknown + 1, lane] -= switches.sign[lane] * (f * real - e * imaginary)


@borrowing_jit
def _correct(equations: Equations, paths: Paths, lane_flow: LaneFlow, switches: Switches) -> None:
    """Between the two substitutions: account for the change of the matrix."""
    answer = switches.answer
    for lane in range(WIDTH):
        if lane_flow.active[0, lane] == 0.0:
            continue
        step = lane_flow.step[:, lane]
        for end in range(2):
            angle = growth = 0.0
            node = switches.node[lane, end]
            if node < equations.n_free:
                unknown, left = paths.unknown[node], paths.left[node]
                for place in range(paths.size[node]):
                    value = step[unknown[place]]
                    angle += left[place, 0] * value
                    growth += left[place, 1] * value
            answer[2 * end] = angle
            answer[2 * end + 1] = growth
        gain = switches.gain[lane]
        for end in range(2):
            active = reactive = 0.0
            for k in range(4):
                active += gain[2 * end, k] * answer[k]
                reactive += gain[2 * end + 1, k] * answer[k]
            node = switches.node[lane, end]
            if node < equations.n_free:
                unknown, right = paths.unknown[node], paths.right[node]
                for place in range(paths.size[node]):
                    step[unknown[place]] += right[place, 0] * active + right[place, 1] * reactive


@borrowing_jit
def _write_loadings_here(network: Network, limit: F64, lane_flow: LaneFlow, switches: Switches) -> None:
    """Squared loadings of the lines that were switched."""
    voltage = lane_flow.voltage
    for lane in range(WIDTH):
        line = switches.line[lane]
        lane_flow.loading[line, lane] = 0.0
        if switches.sign[lane] > 0.0:
            continue
        y, origin, extremity = network.line_admittance[line], switches.node[lane, 0], switches.node[lane, 1]
        e1, f1 = voltage[origin, 0, lane], voltage[origin, 1, lane]
        e2, f2 = voltage[extremity, 0, lane], voltage[extremity, 1, lane]
        real = y[0] * e1 - y[1] * f1 + y[2] * e2 - y[3] * f2
        imaginary = y[0] * f1 + y[1] * e1 + y[2] * f2 + y[3] * e2
        lane_flow.loading[line, lane] = (real * real + imaginary * imaginary) * limit[line] ** 2


@borrowing_jit
def is_bridge(flow: FlowState, i: Index, equations: Equations, switches: Switches, line: Index) -> bool:
    """Whether a closed line is the only way between its ends."""
    origin, extremity = np.int64(flow.line_or_node[i, line]), np.int64(flow.line_ex_node[i, line])
    seen, queue = switches.seen, switches.queue
    for node in range(equations.n_free + 1):
        seen[node] = 0
    seen[origin] = 1
    queue[0] = origin
    visited, found = 0, 1
    while visited < found:
        here = np.int64(queue[visited])
        visited += 1
        for entry in range(equations.admittance_first[here], equations.admittance_first[here + 1]):
            there = np.int64(equations.admittance_node[entry])
            if not is_joined(equations.admittance, entry):
                continue
            if there == extremity:
                if here != origin:
                    return False
                continue
            if seen[there] == 0:
                seen[there] = 1
                queue[found] = there
                found += 1
    line_or, line_ex = flow.line_or_node[i], flow.line_ex_node[i]
    for other in range(line_or.shape[0]):
        if other == line or line_or[other] == ABSENT:
            continue
        a, b = np.int64(line_or[other]), np.int64(line_ex[other])
        if (a == origin and b == extremity) or (a == extremity and b == origin):
            return False
    return True
