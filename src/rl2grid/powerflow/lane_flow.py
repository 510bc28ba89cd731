"""What the batched power flows share: the equations in lanes, when a lane is done, and line loadings."""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple, Protocol

import numpy as np

from rl2grid.arrays import F64, I8, I32, Index
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.factors import ONE, TWO
from rl2grid.powerflow.flow_state import ABSENT, Equations, FlowState
from rl2grid.powerflow.lanes import WIDTH, Lanes, at, fma, larger, load, root, splat, store
from rl2grid.powerflow.model import Network
from rl2grid.structures import allocate, workspace

RUNNING, LAST_STEP, DONE, FAILED, EMPTY = range(5)
"""States of a lane."""
MAX_STEPS = 20
_TOLERANCE = 3e-4
"""MVA: the mismatch (Euclidean norm) that a lane may leave; loadings are then right to about 1e-5."""
_EXACT = 0.01
"""Share of the tolerance below which no further step is taken; a slow lane's distance from the solution is many times
that of its next step."""
_SAFETY = 4.0
"""How much slower than from the last step a lane may converge in the next."""
_SLOWEST = 0.8
"""From the second step on, a lane that keeps more of its mismatch than this is handed to the cold recipe."""
_FARTHEST = 0.5
"""So far from the base case, per unit, the cold recipe has to confirm a solution."""


class LaneFlow(NamedTuple):
    """Power flows side by side."""

    voltage: Annotated[Lanes, workspace("bus 2 lane", "by node; real and imaginary", "per unit")]
    step: Annotated[Lanes, workspace("unknown lane", "mismatch, then Newton step")]
    active: Annotated[Lanes, workspace("1 lane", "1.0 in lanes under way")]
    norm: Annotated[Lanes, workspace("1 lane", "of the mismatch", "per unit")]
    norm_before: Annotated[Lanes, workspace("1 lane", "of the mismatch a step ago", "per unit")]
    distance: Annotated[Lanes, workspace("1 lane", "largest change of a voltage since the base case", "per unit")]
    loading: Annotated[Lanes, workspace("line lane", "relative to the thermal limit, squared")]
    worst: Annotated[Lanes, workspace("1 lane", "worst loading")]

    state: Annotated[I8, workspace("lane", "RUNNING, LAST_STEP, DONE, FAILED or EMPTY")]
    action: Annotated[I32, workspace("lane", "entry of the request that a lane works for")]
    admittance: Annotated[F64, workspace("entry 2", "of the lines that no lane treats in its own way", "per unit")]
    injection: Annotated[F64, workspace("bus 2", "by node; active and reactive", "per unit")]


class Stepped(Protocol):
    """Flows side by side, as the functions below need them: a :class:`LaneFlow`, or one of another kind."""

    @property
    def voltage(self) -> Lanes: ...
    @property
    def step(self) -> Lanes: ...
    @property
    def active(self) -> Lanes: ...
    @property
    def distance(self) -> Lanes: ...
    @property
    def state(self) -> I8: ...


def new_lane_flow(n_bus: int, n_line: int) -> LaneFlow:
    """Blank lanes for a grid."""
    sizes = {"bus": n_bus, "unknown": 2 * n_bus, "entry": n_bus + 2 * n_line, "line": n_line, "lane": WIDTH}
    lanes = allocate(LaneFlow, sizes)
    lanes.state[:] = EMPTY
    return lanes


@borrowing_jit
def begin_lanes(lane_flow: LaneFlow, equations: Equations) -> None:
    """Start every lane from the base case, without any mismatch."""
    for node in range(equations.n_free + 1):
        store(lane_flow.voltage, 2 * node, at(equations.voltage, 2 * node))
        store(lane_flow.voltage, 2 * node + 1, at(equations.voltage, 2 * node + 1))
    for unknown in range(equations.first_unknown[equations.n_free]):
        store(lane_flow.step, unknown, splat(0.0))
    for lane in range(WIDTH):
        lane_flow.active[0, lane] = 0.0
        if lane_flow.state[lane] == RUNNING:
            lane_flow.active[0, lane] = 1.0


@borrowing_jit
def measure_lanes(lane_flow: LaneFlow, equations: Equations) -> None:
    """Write the mismatch of every lane, but for the lines that it treats in its own way."""
    first, column, first_unknown = equations.admittance_first, equations.admittance_node, equations.first_unknown
    voltage, admittance, injection = lane_flow.voltage, lane_flow.admittance, lane_flow.injection
    for node in range(equations.n_free):
        real = imaginary = splat(0.0)
        for entry in range(first[node], first[node + 1]):
            other = TWO * np.uint64(column[entry])
            g, b = at(admittance, 2 * entry), at(admittance, 2 * entry + 1)
            e, f = load(voltage, other), load(voltage, other + ONE)
            real = fma(-b, f, fma(g, e, real))
            imaginary = fma(b, e, fma(g, f, imaginary))
        e, f = load(voltage, 2 * node), load(voltage, 2 * node + 1)
        unknown = first_unknown[node]
        store(lane_flow.step, unknown, fma(f, imaginary, fma(e, real, -at(injection, 2 * node))))
        if first_unknown[node + 1] - unknown == 2:
            store(lane_flow.step, unknown + ONE, fma(-e, imaginary, fma(f, real, -at(injection, 2 * node + 1))))


@borrowing_jit
def add_power(lane_flow: LaneFlow, equations: Equations, node: Index, active, reactive) -> None:  # type: ignore[no-untyped-def]
    """Add power drawn from a node, lanes, to its mismatch."""
    if node >= equations.n_free:
        return
    unknown = equations.first_unknown[node]
    store(lane_flow.step, unknown, load(lane_flow.step, unknown) + active)
    if equations.first_unknown[node + 1] - unknown == 2:
        store(lane_flow.step, unknown + ONE, load(lane_flow.step, unknown + ONE) + reactive)


@borrowing_jit
def square_step(lane_flow: LaneFlow, equations: Equations):  # type: ignore[no-untyped-def]
    """Sum of the squares of the mismatch, lanes."""
    total = splat(0.0)
    for unknown in range(equations.first_unknown[equations.n_free]):
        value = load(lane_flow.step, unknown)
        total = fma(value, value, total)
    return total


@borrowing_jit
def judge_lanes(lane_flow: LaneFlow, n_steps: int, base_power: float) -> bool:
    """Decide which lanes go on; whether any does.

    Chord steps converge linearly after the first: a lane takes its last step unmeasured when even a rate some times
    worse than the last one's would do.
    """
    tolerance = _TOLERANCE / base_power
    going_on = False
    for lane in range(WIDTH):
        state = lane_flow.state[lane]
        if state == LAST_STEP:
            state = DONE
        if state == RUNNING:
            norm, before = lane_flow.norm[0, lane], lane_flow.norm_before[0, lane]
            if norm < _EXACT * tolerance:
                state = DONE
            elif not math.isfinite(norm) or n_steps == MAX_STEPS or (n_steps >= 2 and norm > _SLOWEST * before):
                state = FAILED
            elif n_steps >= 1 and _SAFETY * norm * norm < tolerance * (before - norm):
                state = LAST_STEP
        lane_flow.state[lane] = state
        lane_flow.norm_before[0, lane] = lane_flow.norm[0, lane]
        under_way = state in (RUNNING, LAST_STEP)
        lane_flow.active[0, lane] = 1.0 if under_way else 0.0
        going_on |= under_way
    return going_on


@borrowing_jit
def any_lane_runs(lane_flow: LaneFlow) -> bool:
    """Whether the mismatch of some lane has to be measured again."""
    running = False
    for lane in range(WIDTH):
        running |= lane_flow.state[lane] == RUNNING
    return running


@borrowing_jit
def turn(voltage: Lanes, row: Index, angle, growth) -> None:  # type: ignore[no-untyped-def]
    """Turn the voltage at ``row`` by an angle and multiply its magnitude by ``1 + growth``; lanes.

    By Cayley's formula, which keeps magnitudes to the last bit or so; it turns by 2 atan(angle / 2), as good a step.
    """
    half = splat(0.5) * angle
    square = half * half
    scale = (splat(1.0) + growth) / (splat(1.0) + square)
    cosine, sine = (splat(1.0) - square) * scale, angle * scale
    e, f = load(voltage, row), load(voltage, row + 1)
    store(voltage, row, fma(-f, sine, e * cosine))
    store(voltage, row + 1, fma(e, sine, f * cosine))


@borrowing_jit
def step_lanes(lane_flow: Stepped, equations: Equations) -> None:
    """Subtract the Newton step from the angles and magnitudes of lanes under way."""
    first_unknown = equations.first_unknown
    towards = -load(lane_flow.active, 0)
    for node in range(equations.n_free):
        unknown = first_unknown[node]
        angle = load(lane_flow.step, unknown) * towards
        growth = splat(0.0)
        if first_unknown[node + 1] - unknown == 2:
            growth = load(lane_flow.step, unknown + ONE) * towards
        turn(lane_flow.voltage, 2 * node, angle, growth)


@borrowing_jit
def squared_change(e, f, e_before, f_before):  # type: ignore[no-untyped-def]
    """Square of a change of voltage, lanes."""
    de, df = e - e_before, f - f_before
    return fma(de, de, df * df)


@borrowing_jit
def measure_distance(lane_flow: Stepped, equations: Equations) -> None:
    """Write how far each lane is from the base case."""
    farthest = splat(0.0)
    for node in range(equations.n_free + 1):
        change = squared_change(  # type: ignore[no-untyped-call]
            load(lane_flow.voltage, 2 * node),
            load(lane_flow.voltage, 2 * node + 1),
            at(equations.voltage, 2 * node),
            at(equations.voltage, 2 * node + 1),
        )
        farthest = larger(farthest, change)
    store(lane_flow.distance, 0, root(farthest))


@borrowing_jit
def dismiss_distant_lanes(lane_flow: Stepped) -> None:
    """Let lanes fail whose solution the cold recipe has to confirm."""
    for lane in range(WIDTH):
        if lane_flow.state[lane] == DONE and not lane_flow.distance[0, lane] < _FARTHEST:
            lane_flow.state[lane] = FAILED


@borrowing_jit
def squared_loading(network: Network, limit: F64, line: Index, e1, f1, e2, f2):  # type: ignore[no-untyped-def]
    """Square of the loading of a line with these voltages at its ends, lanes."""
    y = network.line_admittance
    real = at(y, 8 * line) * e1 - at(y, 8 * line + 1) * f1 + at(y, 8 * line + 2) * e2 - at(y, 8 * line + 3) * f2
    imaginary = at(y, 8 * line) * f1 + at(y, 8 * line + 1) * e1 + at(y, 8 * line + 2) * f2 + at(y, 8 * line + 3) * e2
    scale = at(limit, line)
    return fma(real, real, imaginary * imaginary) * (scale * scale)


@borrowing_jit
def write_loadings(network: Network, flow: FlowState, i: Index, limit: F64, lane_flow: LaneFlow) -> None:
    """Write the squared loading of every line of the base topology."""
    origins, extremities = flow.line_or_node[i], flow.line_ex_node[i]
    voltage = lane_flow.voltage
    for line in range(origins.shape[0]):
        if origins[line] == ABSENT:
            store(lane_flow.loading, line, splat(0.0))
            continue
        origin, extremity = 2 * np.int64(origins[line]), 2 * np.int64(extremities[line])
        value = squared_loading(
            network, limit, line, load(voltage, origin), load(voltage, origin + 1), load(voltage, extremity),
            load(voltage, extremity + 1),
        )  # fmt: skip
        store(lane_flow.loading, line, value)


@borrowing_jit
def find_worst(lane_flow: LaneFlow) -> None:
    """Write the worst loading of every lane."""
    worst = splat(0.0)
    for line in range(lane_flow.loading.shape[0]):
        worst = larger(worst, load(lane_flow.loading, line))
    store(lane_flow.worst, 0, root(worst))
