"""Newton's method in polar coordinates on the nodes of one environment.

Magnitudes are solved for relative to themselves. The equations are written once, for one environment and for lanes of
several (:mod:`rl2grid.powerflow.warm_lanes`, :mod:`rl2grid.powerflow.cold_lanes`), which therefore find the same bits.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rl2grid.arrays import F32, F64, U16
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.factors import ONE, THREE, TWO, factorise, solve
from rl2grid.powerflow.flow_state import ABSENT, Equations, Factors, FlowState
from rl2grid.powerflow.lanes import entries, larger, like, where_equal, where_less
from rl2grid.powerflow.lanes import magnitude as absolute
from rl2grid.powerflow.model import Network

_ROUND = 6755399441055744.0  # 1.5 * 2**52: adding and subtracting it rounds to the nearest whole number
_HALF_PI_HIGH = 1.5707963267341256
_HALF_PI_LOW = 6.077100506506192e-11
_TRUSTED_STEPS = 5
"""Newton steps of a cold flow that leave no doubt about its neighbours."""
_WARM_STEPS = 8
_SLOWEST = 0.5
"""A warm step that leaves more of the mismatch than this is no good step."""
ARRIVED, STUCK, RENEW, STEP = range(4)
"""What becomes of a flow: it is solved; it cannot be solved in this way; it needs new factors for its next step; or
it takes another with those that it has."""
_MAGNITUDE_RANGE = 0.03
_ANGLE_RANGE = 0.1
"""How far from the anchor a warm solution may be, per unit and radians."""
_node_at, _set_node = entries(1)
_part_at, _set_part = entries(2)


@borrowing_jit
def write_voltage(equations: Equations) -> None:
    """Real and imaginary parts from magnitudes and angles.

    Written out, with the polynomials of fdlibm, so that it runs in SIMD and gives the same bits everywhere.
    """
    magnitude, angle, voltage = equations.magnitude, equations.angle, equations.voltage
    for node in range(equations.n_free + 1):
        turned = _node_at(angle, node)
        quarter = (turned * (2.0 / math.pi) + _ROUND) - _ROUND
        x = (turned - quarter * _HALF_PI_HIGH) - quarter * _HALF_PI_LOW
        turn = quarter - 4.0 * ((quarter * 0.25 + _ROUND) - _ROUND)  # -2, -1, 0, 1 or 2
        z = x * x
        sine = z * 1.58969099521155010221e-10 + -2.50507602534068634195e-08
        sine = 2.75573137070700676789e-06 + z * sine
        sine = -1.98412698298579493134e-04 + z * sine
        sine = 8.33333333332248946124e-03 + z * sine
        sine = -1.66666666666666324348e-01 + z * sine
        sine = x + x * (z * sine)
        cosine = z * -1.13596475577881948265e-11 + 2.08757232129817482790e-09
        cosine = -2.75573143513906633035e-07 + z * cosine
        cosine = 2.48015872894767294178e-05 + z * cosine
        cosine = -1.38888888888741095749e-03 + z * cosine
        cosine = 4.16666666666666019037e-02 + z * cosine
        cosine = (1.0 - 0.5 * z) + z * z * cosine
        across_the_axis = absolute(turn)
        along = where_equal(across_the_axis, 1.0, -sine * turn, where_equal(turn, 0.0, cosine, -cosine))
        across = where_equal(across_the_axis, 1.0, cosine * turn, where_equal(turn, 0.0, sine, -sine))
        _set_part(voltage, 2 * node, _node_at(magnitude, node) * along)
        _set_part(voltage, 2 * node + 1, _node_at(magnitude, node) * across)


@borrowing_jit
def measure_mismatch(equations: Equations) -> Any:
    """Write the power that the voltages give, and as ``step`` its mismatch.

    Returns:
        The largest mismatch, NaN if any is not finite.
    """
    first, column, value = equations.admittance_first, equations.admittance_node, equations.admittance
    voltage, injection, power = equations.voltage, equations.injection, equations.power
    first_unknown, step = equations.first_unknown, equations.step
    worst = spoiled = like(_part_at(voltage, 0), 0.0)
    for node in range(equations.n_free):
        real = imaginary = like(worst, 0.0)
        for entry in range(first[node], first[node + 1]):
            other = TWO * column[entry]
            e, f = _part_at(voltage, other), _part_at(voltage, other + ONE)
            conductance, susceptance = _part_at(value, 2 * entry), _part_at(value, 2 * entry + 1)
            real += conductance * e - susceptance * f
            imaginary += conductance * f + susceptance * e
        e, f = _part_at(voltage, 2 * node), _part_at(voltage, 2 * node + 1)
        active, reactive = e * real + f * imaginary, f * real - e * imaginary
        _set_part(power, 2 * node, active)
        _set_part(power, 2 * node + 1, reactive)
        unknown = np.uint64(first_unknown[node])
        difference = active - _part_at(injection, 2 * node)
        _set_node(step, unknown, difference)
        worst = larger(worst, absolute(difference))
        spoiled += 0.0 * difference
        if first_unknown[node + 1] - first_unknown[node] == 2:
            difference = reactive - _part_at(injection, 2 * node + 1)
            _set_node(step, unknown + ONE, difference)
            worst = larger(worst, absolute(difference))
            spoiled += 0.0 * difference
    return worst + spoiled


@borrowing_jit
def fill_jacobian(equations: Equations, factors: Factors) -> None:
    """Derivatives of the power at the present voltages."""
    first, column, value = equations.admittance_first, equations.admittance_node, equations.admittance
    voltage, power, n_free = equations.voltage, equations.power, equations.n_free
    first_unknown, block, panel = equations.first_unknown, equations.admittance_panel, factors.panel
    for k in range(factors.first_panel[n_free]):
        _set_node(panel, k, 0.0)
    for node in range(n_free):
        e, f = _part_at(voltage, 2 * node), _part_at(voltage, 2 * node + 1)
        rows = first_unknown[node + 1] - first_unknown[node]
        for entry in range(first[node], first[node + 1]):
            other = column[entry]
            if other >= n_free:
                continue
            e2, f2 = _part_at(voltage, TWO * other), _part_at(voltage, TWO * other + ONE)
            conductance, susceptance = _part_at(value, 2 * entry), _part_at(value, 2 * entry + 1)
            real = conductance * e2 - susceptance * f2
            imaginary = conductance * f2 + susceptance * e2
            along = e * real + f * imaginary
            across = f * real - e * imaginary
            p_angle, p_magnitude, q_angle, q_magnitude = across, along, -along, across
            if other == node:
                active, reactive = _part_at(power, 2 * node), _part_at(power, 2 * node + 1)
                p_angle -= reactive
                p_magnitude += active
                q_angle += active
                q_magnitude += reactive
            at = np.uint64(block[entry])
            columns = first_unknown[other + ONE] - first_unknown[other]
            _set_node(panel, at, p_angle)
            if rows == 2:
                _set_node(panel, at + ONE, q_angle)
            if columns == 2:
                _set_node(panel, at + np.uint64(rows), p_magnitude)
                if rows == 2:
                    _set_node(panel, at + THREE, q_magnitude)


@borrowing_jit
def fill_dc(network: Network, flow: FlowState, i: int, equations: Equations, factors: Factors) -> None:
    """The DC matrix in the Jacobian's pattern (magnitudes stay), and its right-hand side as ``step``."""
    n_free, panel, diagonal = equations.n_free, factors.panel, flow.diagonal_entry[i]
    first_unknown, block = equations.first_unknown, equations.admittance_panel
    injection, step = equations.injection, equations.step
    for k in range(factors.first_panel[n_free]):
        panel[k] = 0.0
    for node in range(n_free):
        step[first_unknown[node]] = injection[node, 0]
        if first_unknown[node + 1] - first_unknown[node] == 2:
            step[first_unknown[node] + ONE] = 0.0
            panel[np.uint64(block[diagonal[node]]) + THREE] = 1.0
    for shunt in range(network.shunt_sub.shape[0]):
        node = flow.node_of_bus[i, network.shunt_sub[shunt]]
        if node < n_free:
            step[first_unknown[node]] -= network.shunt_admittance[shunt, 0]
    line_or, line_ex, line_entry = flow.line_or_node[i], flow.line_ex_node[i], flow.line_entry[i]
    for line in range(line_or.shape[0]):
        origin, extremity = line_or[line], line_ex[line]
        if origin == ABSENT:
            continue
        if origin < n_free:
            panel[block[diagonal[origin]]] += network.line_susceptance[line]
            if extremity < n_free:
                panel[block[line_entry[line, 0]]] -= network.line_susceptance[line]
        if extremity < n_free:
            panel[block[diagonal[extremity]]] += network.line_susceptance[line]
            if origin < n_free:
                panel[block[line_entry[line, 1]]] -= network.line_susceptance[line]


@borrowing_jit
def apply_step(equations: Equations) -> None:
    """Subtract the Newton step from angles and magnitudes."""
    first_unknown, step = equations.first_unknown, equations.step
    magnitude, angle = equations.magnitude, equations.angle
    for node in range(equations.n_free):
        unknown = np.uint64(first_unknown[node])
        turned = _node_at(angle, node) - _node_at(step, unknown)
        if first_unknown[node + 1] - first_unknown[node] == 2:
            size = _node_at(magnitude, node) * (1.0 - _node_at(step, unknown + ONE))
            turned = where_less(size, 0.0, turned + math.pi, turned)
            _set_node(magnitude, node, where_less(size, 0.0, -size, size))
        whole = (turned * (0.5 / math.pi) + _ROUND) - _ROUND
        _set_node(angle, node, where_less(math.pi, absolute(turned), turned - 2.0 * math.pi * whole, turned))
    write_voltage(equations)


@borrowing_jit
def solve_cold(network: Network, flow: FlowState, i: int, equations: Equations, factors: Factors) -> bool:
    """LightSim2Grid's recipe: set-point or unit magnitudes, angles of the DC flow, then Newton steps.

    Args:
        network: electrical model of the grid.
        flow: rows of environments.
        i: row.
        equations: views of the row; magnitudes are those to start from.
        factors: views of the row, or of arrays beside it.

    Returns:
        Whether ``max_iterations`` Newton steps bring every mismatch below the tolerance. If so, row ``i`` holds
        the voltages and remembers them as its anchor.
    """
    fill_dc(network, flow, i, equations, factors)
    if factorise(factors) == 0.0:
        return False
    step, angle = equations.step, equations.angle
    solve(factors, step)
    for node in range(equations.n_free):
        angle[node] = step[equations.first_unknown[node]]
    angle[equations.n_free] = 0.0
    write_voltage(equations)
    return go_on_cold(network, flow, i, equations, factors, 0, math.inf)


@borrowing_jit
def go_on_cold(
    network: Network, flow: FlowState, i: int, equations: Equations, factors: Factors, n_steps: int, ratio: float
) -> bool:
    """Take Newton steps from where a cold flow stands: ``n_steps`` behind it, ``ratio`` as of :func:`judge_cold`.

    Other arguments and what it returns are as of :func:`solve_cold`.
    """
    mismatch = measure_mismatch(equations)
    while True:
        verdict = judge_cold(n_steps, mismatch, ratio, network.tolerance[0], network.max_iterations[0])
        if verdict == ARRIVED:
            drop_anchor(flow, i, n_steps)
            return True
        if verdict == STUCK:
            return False
        if verdict == RENEW:
            fill_jacobian(equations, factors)
            if factorise(factors) == 0.0:
                return False
        solve(factors, equations.step)
        apply_step(equations)
        before = mismatch
        mismatch = measure_mismatch(equations)
        ratio = mismatch / before
        n_steps += 1


@borrowing_jit
def judge_cold(n_steps: int, mismatch: float, ratio: float, tolerance: float, most_steps: int) -> int:
    """How a flow goes on that began at unit magnitudes: ARRIVED, STUCK, RENEW or STEP.

    Args:
        n_steps: that it has taken.
        mismatch: that they have left, per unit.
        ratio: of that to the one before the last step, infinite before the first.
        tolerance: per unit.
        most_steps: that it may take.
    """
    if mismatch < tolerance:
        return ARRIVED
    if n_steps == most_steps or not math.isfinite(mismatch):
        return STUCK
    # So close to the solution the last factors do as well as new ones, and a full step would surely converge.
    return STEP if n_steps <= _TRUSTED_STEPS and mismatch * (4.0 * ratio) ** 2 < tolerance else RENEW


@borrowing_jit
def drop_anchor(flow: FlowState, i: int, n_steps: int) -> None:
    """Remember a solution that the cold recipe found, and in how many steps."""
    magnitude, angle, anchor = flow.magnitude[i], flow.angle[i], flow.anchor[i]
    for node in range(flow.n_node[i]):
        anchor[node, 0] = magnitude[node]
        anchor[node, 1] = angle[node]
    flow.anchor_steps[i] = n_steps


@borrowing_jit
def solve_warm(
    network: Network, flow: FlowState, i: int, gen_v: F32 | F64, equations: Equations, factors: Factors
) -> bool:
    """Go on from the voltages and factors of the last flow, which had the same topology.

    Returns:
        Whether a solution was found for which the cold recipe can be trusted to find the same: few good steps lead
        to it, and it is close to a solution (the anchor) that the cold recipe did find without trouble.
    """
    if _change_setpoints(equations, flow.gen_node[i], gen_v):
        write_voltage(equations)
    mismatch, ratio = measure_mismatch(equations), 0.0
    for n_steps in range(_WARM_STEPS + 1):
        verdict = judge_warm(n_steps, mismatch, ratio, network.tolerance[0])
        if verdict == ARRIVED:
            return _is_near_anchor(equations, flow.anchor[i])
        if verdict == STUCK:
            return False
        if verdict == RENEW:
            fill_jacobian(equations, factors)
            if factorise(factors) == 0.0:
                return False
        solve(factors, equations.step)
        apply_step(equations)
        before = mismatch
        mismatch = measure_mismatch(equations)
        ratio = mismatch / before
    return False


@borrowing_jit
def may_go_on(flow: FlowState, i: int) -> bool:
    """Whether row ``i`` has a solved flow of its topology to go on from, near which the cold recipe had no trouble."""
    return bool(flow.warm[i]) and flow.anchor_steps[i] <= _TRUSTED_STEPS


@borrowing_jit
def judge_warm(n_steps: int, mismatch: float, ratio: float, tolerance: float) -> int:
    """How a flow goes on that went on from the last one: ARRIVED, STUCK, RENEW or STEP.

    Args:
        n_steps: that it has taken.
        mismatch: that they have left, per unit.
        ratio: of that to the one before the last step, 0 before the first.
        tolerance: per unit.
    """
    if mismatch < tolerance:
        return ARRIVED
    if n_steps == _WARM_STEPS or not ratio < _SLOWEST:
        return STUCK
    # Factors of the last flow do for the first step; then new ones, unless three steps more will do.
    return RENEW if n_steps > 0 and not mismatch * ratio**3 < tolerance else STEP


@borrowing_jit
def _change_setpoints(equations: Equations, gen_node: U16, gen_v: F32 | F64) -> bool:
    """Impose the voltages that generators hold; whether any differs from before."""
    magnitude = equations.magnitude
    changed = False
    for gen in range(gen_node.shape[0]):
        changed |= magnitude[gen_node[gen]] != gen_v[gen]
        magnitude[gen_node[gen]] = gen_v[gen]
    return changed


@borrowing_jit
def _is_near_anchor(equations: Equations, anchor: F64) -> bool:
    magnitude, angle = equations.magnitude, equations.angle
    far = False
    for node in range(equations.n_free + 1):
        far |= is_far(magnitude[node], angle[node], anchor[node, 0], anchor[node, 1])
    return not far


@borrowing_jit
def is_far(magnitude: float, angle: float, anchor_magnitude: float, anchor_angle: float) -> bool:
    """Whether a node's voltage is too far from where the cold recipe found it to be trusted; per unit and radians."""
    return abs(magnitude - anchor_magnitude) > _MAGNITUDE_RANGE or abs(angle - anchor_angle) > _ANGLE_RANGE
