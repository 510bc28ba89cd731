"""Newton's method on one flow per lane: injections, an opened line and factors of its own, a topology in common."""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from rl2grid.arrays import F32, F64, I8, I32, U16, Index
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.factors import ONE, THREE, TWO
from rl2grid.powerflow.flow_state import ABSENT, Equations, Factors, FlowState
from rl2grid.powerflow.lane_factors import LaneFactors, factorise_lanes
from rl2grid.powerflow.lane_flow import DONE, FAILED, RUNNING, dismiss_distant_lanes, measure_distance, step_lanes
from rl2grid.powerflow.lanes import WIDTH, Lanes, at, fma, lanes_at, larger, load, magnitude, root, splat, store
from rl2grid.powerflow.model import Network
from rl2grid.powerflow.paths import solve_backward, solve_forward
from rl2grid.structures import allocate, workspace

NO_LINE = -1
_SHARED_STEPS = 2
"""Steps of a row with the factors of the base case before its own are made; none, one, three and four were no faster on
bus14 and bus118-M."""
_OUTAGE_FACTORS = 2
"""Steps after an outage for which factors are made anew: after one alone some lanes converged too slowly, three took
longer."""
_MAX_STEPS = 12
_SLOWEST = 0.5
"""From the third step on, a lane that keeps more of its mismatch than this is handed to the cold recipe."""
_SETPOINT_TOLERANCE = 1e-7
"""Per unit, as in :mod:`rl2grid.powerflow.ac`."""
_admittance_at = lanes_at(2)
"""A number of the admittance matrix that all lanes share, or of each lane's own."""


class RowLanes(NamedTuple):
    """Power flows side by side."""

    voltage: Annotated[Lanes, workspace("bus 2 lane", "by node; real and imaginary", "per unit")]
    injection: Annotated[Lanes, workspace("bus 2 lane", "by node; active and reactive", "per unit")]
    admittance: Annotated[Lanes, workspace("entry 2 lane", "without the opened line", "per unit")]
    step: Annotated[Lanes, workspace("unknown lane", "mismatch, then Newton step")]
    active: Annotated[Lanes, workspace("1 lane", "1.0 in lanes under way")]
    mismatch: Annotated[Lanes, workspace("1 lane", "largest; not a number if any is not finite", "per unit")]
    mismatch_before: Annotated[Lanes, workspace("1 lane", "a step ago", "per unit")]
    distance: Annotated[Lanes, workspace("1 lane", "largest change of a voltage since the base case", "per unit")]
    current: Annotated[Lanes, workspace("line lane", "at the origin", "kA")]
    power: Annotated[Lanes, workspace("line lane", "active, entering at the origin", "MW")]
    slack_p: Annotated[Lanes, workspace("1 lane", "production of the slack generator", "per unit")]

    state: Annotated[I8, workspace("lane", "RUNNING, DONE, FAILED or EMPTY")]
    case: Annotated[I32, workspace("lane", "flow that it works for")]
    line: Annotated[I32, workspace("lane", "that it opens, or NO_LINE")]
    setpoint: Annotated[F64, workspace("bus", "by node; of one lane", "per unit")]


def new_row_lanes(n_bus: int, n_line: int) -> RowLanes:
    """Blank lanes for a grid."""
    sizes = {"bus": n_bus, "unknown": 2 * n_bus, "entry": n_bus + 2 * n_line, "line": n_line, "lane": WIDTH}
    return allocate(RowLanes, sizes)


@borrowing_jit
def write_admittance(equations: Equations, lanes: RowLanes) -> None:
    """Give every lane the admittance matrix of the topology."""
    for k in range(2 * equations.admittance_first[equations.n_free + 1]):
        store(lanes.admittance, k, at(equations.admittance, k))


@borrowing_jit
def begin_lanes(equations: Equations, lanes: RowLanes) -> None:
    """Start every lane from the base case."""
    for k in range(2 * (equations.n_free + 1)):
        store(lanes.voltage, k, at(equations.voltage, k))
        store(lanes.injection, k, at(equations.injection, k))


@borrowing_jit
def hold_voltages(equations: Equations, gen_node: U16, gen_v: F64, lanes: RowLanes, lane: Index) -> bool:
    """Impose the set-points, per unit, on a lane; False if generators on one bus want different voltages."""
    voltage, setpoint = lanes.voltage, lanes.setpoint
    for gen in range(gen_node.shape[0]):
        setpoint[gen_node[gen]] = gen_v[gen]
    agree = True
    for gen in range(gen_node.shape[0]):
        node = gen_node[gen]
        agree &= not abs(setpoint[node] - gen_v[gen]) > _SETPOINT_TOLERANCE
        if setpoint[node] != equations.magnitude[node]:
            scale = setpoint[node] / equations.magnitude[node]
            voltage[node, 0, lane] = equations.voltage[node, 0] * scale
            voltage[node, 1, lane] = equations.voltage[node, 1] * scale
    return agree


@borrowing_jit
def take_line_out(network: Network, flow: FlowState, i: Index, lanes: RowLanes, lane: Index) -> None:
    """Open the lane's line in its admittance matrix."""
    line, admittance = lanes.line[lane], lanes.admittance
    y, diagonal, entry = network.line_admittance[line], flow.diagonal_entry[i], flow.line_entry[i, line]
    origin, extremity = flow.line_or_node[i, line], flow.line_ex_node[i, line]
    for part in range(2):
        admittance[diagonal[origin], part, lane] -= y[part]
        admittance[entry[0], part, lane] -= y[2 + part]
        admittance[entry[1], part, lane] -= y[4 + part]
        admittance[diagonal[extremity], part, lane] -= y[6 + part]


@borrowing_jit
def put_line_back(flow: FlowState, i: Index, lanes: RowLanes, lane: Index) -> None:
    """Give the lane the admittance matrix of the topology again, bit by bit."""
    line, admittance, whole = lanes.line[lane], lanes.admittance, flow.admittance[i]
    diagonal, entry = flow.diagonal_entry[i], flow.line_entry[i, line]
    origin, extremity = flow.line_or_node[i, line], flow.line_ex_node[i, line]
    for part in range(2):
        for place in (diagonal[origin], entry[0], entry[1], diagonal[extremity]):
            admittance[place, part, lane] = whole[place, part]


@borrowing_jit
def solve_rows(
    equations: Equations, factors: Factors, lane_factors: LaneFactors, lanes: RowLanes, tolerance: float
) -> None:
    """Solve the flows of all lanes that are RUNNING, none of which opens a line; they end as DONE or FAILED.

    Every lane takes the same kind of step at the same time, whatever the others need: some with the factors of the base
    case, then one of Newton's with its own, then more with these.
    """
    _solve(equations, factors, lane_factors, lanes, equations.admittance, tolerance, _SHARED_STEPS, 1)


@borrowing_jit
def solve_outages(
    equations: Equations, factors: Factors, lane_factors: LaneFactors, lanes: RowLanes, tolerance: float
) -> None:
    """Solve the flows of all lanes that are RUNNING; they end as DONE or FAILED.

    As :func:`solve_rows`, but from the first step on with own factors, which are made anew for the second.
    """
    _solve(equations, factors, lane_factors, lanes, lanes.admittance, tolerance, 0, _OUTAGE_FACTORS)


@borrowing_jit
def _solve(
    equations: Equations, factors: Factors, lane_factors: LaneFactors, lanes: RowLanes, admittance: F64,
    tolerance: float, n_shared: int, n_own: int,
) -> None:  # fmt: skip
    _measure(equations, lanes, admittance)
    n_steps = 0
    while _judge(lanes, n_steps, tolerance):
        if n_steps < n_shared:
            solve_forward(factors, factors.panel, lanes.step)
            solve_backward(factors, factors.panel, lanes.step)
        else:
            if n_steps < n_shared + n_own:
                _fill_jacobian(equations, factors, lane_factors.panel, lanes, admittance)
                factorise_lanes(factors, lane_factors)
            solve_forward(factors, lane_factors.panel, lanes.step)
            solve_backward(factors, lane_factors.panel, lanes.step)
        step_lanes(lanes, equations)
        _measure(equations, lanes, admittance)
        n_steps += 1
    measure_distance(lanes, equations)
    dismiss_distant_lanes(lanes)
    _write_slack(equations, lanes, admittance)


@borrowing_jit
def _measure(equations: Equations, lanes: RowLanes, admittance: F64) -> None:
    """Write the mismatch of every lane."""
    first, column, first_unknown = equations.admittance_first, equations.admittance_node, equations.first_unknown
    voltage, injection = lanes.voltage, lanes.injection
    worst = spoiled = splat(0.0)
    for node in range(equations.n_free):
        real = imaginary = splat(0.0)
        for entry in range(first[node], first[node + 1]):
            other = TWO * np.uint64(column[entry])
            g, b = _admittance_at(admittance, 2 * entry), _admittance_at(admittance, 2 * entry + 1)
            e, f = load(voltage, other), load(voltage, other + ONE)
            real = fma(-b, f, fma(g, e, real))
            imaginary = fma(b, e, fma(g, f, imaginary))
        e, f = load(voltage, 2 * node), load(voltage, 2 * node + 1)
        unknown = first_unknown[node]
        difference = fma(f, imaginary, fma(e, real, -load(injection, 2 * node)))
        store(lanes.step, unknown, difference)
        worst = larger(worst, magnitude(difference))
        spoiled = fma(splat(0.0), difference, spoiled)
        if first_unknown[node + 1] - unknown == 2:
            difference = fma(-e, imaginary, fma(f, real, -load(injection, 2 * node + 1)))
            store(lanes.step, unknown + ONE, difference)
            worst = larger(worst, magnitude(difference))
            spoiled = fma(splat(0.0), difference, spoiled)
    store(lanes.mismatch, 0, worst + spoiled)


@borrowing_jit
def _judge(lanes: RowLanes, n_steps: int, tolerance: float) -> bool:
    """Decide which lanes go on; whether any does."""
    going_on = False
    for lane in range(WIDTH):
        mismatch, before = lanes.mismatch[0, lane], lanes.mismatch_before[0, lane]
        if lanes.state[lane] == RUNNING:
            if mismatch < tolerance:
                lanes.state[lane] = DONE
            elif (
                not math.isfinite(mismatch) or n_steps == _MAX_STEPS or (n_steps >= 3 and mismatch > _SLOWEST * before)
            ):
                lanes.state[lane] = FAILED
        lanes.mismatch_before[0, lane] = mismatch
        lanes.active[0, lane] = 1.0 if lanes.state[lane] == RUNNING else 0.0
        going_on |= lanes.state[lane] == RUNNING
    return going_on


@borrowing_jit
def _fill_jacobian(equations: Equations, factors: Factors, panel: Lanes, lanes: RowLanes, admittance: F64) -> None:
    """Derivatives of the power at the present voltages of every lane."""
    first, column, block = equations.admittance_first, equations.admittance_node, equations.admittance_panel
    voltage, first_unknown = lanes.voltage, equations.first_unknown
    n_free = equations.n_free
    for k in range(factors.first_panel[n_free]):
        store(panel, k, splat(0.0))
    for node in range(n_free):
        e, f = load(voltage, 2 * node), load(voltage, 2 * node + 1)
        rows = np.uint64(first_unknown[node + 1] - first_unknown[node])
        active = reactive = splat(0.0)
        for entry in range(first[node], first[node + 1]):
            other = np.uint64(column[entry])
            g, b = _admittance_at(admittance, 2 * entry), _admittance_at(admittance, 2 * entry + 1)
            e2, f2 = load(voltage, TWO * other), load(voltage, TWO * other + ONE)
            real, imaginary = fma(g, e2, -(b * f2)), fma(g, f2, b * e2)
            along, across = fma(e, real, f * imaginary), fma(f, real, -(e * imaginary))
            active, reactive = active + along, reactive + across
            if other >= n_free:
                continue
            place = np.uint64(block[entry])
            store(panel, place, across)
            if rows == 2:
                store(panel, place + ONE, -along)
            if first_unknown[other + ONE] - first_unknown[other] == 2:
                store(panel, place + rows, along)
                if rows == 2:
                    store(panel, place + THREE, across)
        own = np.uint64(factors.own_panel[node])
        store(panel, own, load(panel, own) - reactive)
        if rows == 2:
            store(panel, own + ONE, load(panel, own + ONE) + active)
            store(panel, own + TWO, load(panel, own + TWO) + active)
            store(panel, own + THREE, load(panel, own + THREE) + reactive)


@borrowing_jit
def write_line_flows(network: Network, flow: FlowState, i: Index, lanes: RowLanes) -> None:
    """Write currents and powers at the origins of all lines, as if no lane had opened one."""
    origins, extremities, y = flow.line_or_node[i], flow.line_ex_node[i], network.line_admittance
    voltage = lanes.voltage
    for line in range(origins.shape[0]):
        if origins[line] == ABSENT:
            store(lanes.current, line, splat(0.0))
            store(lanes.power, line, splat(0.0))
            continue
        origin, extremity = TWO * np.uint64(origins[line]), TWO * np.uint64(extremities[line])
        e1, f1, e2, f2 = (
            load(voltage, origin), load(voltage, origin + ONE), load(voltage, extremity), load(voltage, extremity + ONE)
        )  # fmt: skip
        g11, b11, g12, b12 = at(y, 8 * line), at(y, 8 * line + 1), at(y, 8 * line + 2), at(y, 8 * line + 3)
        real = fma(-b12, f2, fma(g12, e2, fma(-b11, f1, g11 * e1)))
        imaginary = fma(b12, e2, fma(g12, f2, fma(b11, e1, g11 * f1)))
        nominal = network.nominal_voltage[network.line_or_sub[line]]
        base = network.base_power[0] / (math.sqrt(3.0) * nominal)
        store(lanes.current, line, root(fma(real, real, imaginary * imaginary)) * splat(base))
        store(lanes.power, line, fma(e1, real, f1 * imaginary) * splat(network.base_power[0]))


@borrowing_jit
def _write_slack(equations: Equations, lanes: RowLanes, admittance: F64) -> None:
    """Write what the slack generator produces: it balances the flow."""
    slack = equations.n_free
    first, column = equations.admittance_first, equations.admittance_node
    real = imaginary = splat(0.0)
    for entry in range(first[slack], first[slack + 1]):
        other = TWO * np.uint64(column[entry])
        g, b = _admittance_at(admittance, 2 * entry), _admittance_at(admittance, 2 * entry + 1)
        e, f = load(lanes.voltage, other), load(lanes.voltage, other + ONE)
        real = fma(-b, f, fma(g, e, real))
        imaginary = fma(b, e, fma(g, f, imaginary))
    e, f = load(lanes.voltage, 2 * slack), load(lanes.voltage, 2 * slack + 1)
    store(lanes.slack_p, 0, fma(f, imaginary, fma(e, real, -load(lanes.injection, 2 * slack))))


@borrowing_jit
def copy_line_flows(lanes: RowLanes, lane: Index, a_or: F32, p_or: F32) -> None:
    """Currents, A, and powers, MW, of one lane."""
    for line in range(a_or.shape[0]):
        # In kA, rounded, then in A: as LightSimBackend does.
        a_or[line] = np.float32(lanes.current[line, lane]) * np.float32(1000.0)
        p_or[line] = lanes.power[line, lane]
    if lanes.line[lane] != NO_LINE:
        a_or[lanes.line[lane]] = 0.0
        p_or[lanes.line[lane]] = 0.0
