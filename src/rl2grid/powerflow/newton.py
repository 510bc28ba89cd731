"""Newton's method in polar coordinates on the nodes of one environment.

Magnitudes are solved for relative to themselves.
"""

from __future__ import annotations

import math

import numpy as np

from rl2grid.arrays import F32, F64, U16
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.factors import ONE, THREE, factorise, solve
from rl2grid.powerflow.flow_state import ABSENT, Equations, Factors, FlowState
from rl2grid.powerflow.model import Network

_ROUND = 6755399441055744.0  # 1.5 * 2**52: adding and subtracting it rounds to the nearest whole number
_HALF_PI_HIGH = 1.5707963267341256
_HALF_PI_LOW = 6.077100506506192e-11
_TRUSTED_STEPS = 5
"""Newton steps of a cold flow that leave no doubt about its neighbours."""
_WARM_STEPS = 8
_SLOWEST = 0.5
"""A warm step that leaves more of the mismatch than this is no good step."""
_MAGNITUDE_RANGE = 0.03
_ANGLE_RANGE = 0.1
"""How far from the anchor a warm solution may be, per unit and radians."""


@borrowing_jit
def write_voltage(equations: Equations) -> None:
    """Real and imaginary parts from magnitudes and angles.

    Written out, with the polynomials of fdlibm, so that it runs in SIMD and gives the same bits everywhere.
    """
    magnitude, angle, voltage = equations.magnitude, equations.angle, equations.voltage
    for node in range(equations.n_free + 1):
        quarter = (angle[node] * (2.0 / math.pi) + _ROUND) - _ROUND
        x = (angle[node] - quarter * _HALF_PI_HIGH) - quarter * _HALF_PI_LOW
        turn = quarter - 4.0 * ((quarter * 0.25 + _ROUND) - _ROUND)  # -2, -1, 0, 1 or 2
        z = x * x
        sine = 1.58969099521155010221e-10
        sine = -2.50507602534068634195e-08 + z * sine
        sine = 2.75573137070700676789e-06 + z * sine
        sine = -1.98412698298579493134e-04 + z * sine
        sine = 8.33333333332248946124e-03 + z * sine
        sine = -1.66666666666666324348e-01 + z * sine
        sine = x + x * (z * sine)
        cosine = -1.13596475577881948265e-11
        cosine = 2.08757232129817482790e-09 + z * cosine
        cosine = -2.75573143513906633035e-07 + z * cosine
        cosine = 2.48015872894767294178e-05 + z * cosine
        cosine = -1.38888888888741095749e-03 + z * cosine
        cosine = 4.16666666666666019037e-02 + z * cosine
        cosine = (1.0 - 0.5 * z) + z * z * cosine
        odd = abs(turn) == 1.0
        along = -sine * turn if odd else (cosine if turn == 0.0 else -cosine)
        across = cosine * turn if odd else (sine if turn == 0.0 else -sine)
        voltage[node, 0] = magnitude[node] * along
        voltage[node, 1] = magnitude[node] * across


@borrowing_jit
def measure_mismatch(equations: Equations) -> float:
    """Write the power that the voltages give, and as ``step`` its mismatch.

    Returns:
        The largest mismatch, NaN if any is not finite.
    """
    first, column, value = equations.admittance_first, equations.admittance_node, equations.admittance
    voltage, injection, power = equations.voltage, equations.injection, equations.power
    first_unknown, step = equations.first_unknown, equations.step
    worst = 0.0
    spoiled = 0.0
    for node in range(equations.n_free):
        real = 0.0
        imaginary = 0.0
        for entry in range(first[node], first[node + 1]):
            other = column[entry]
            real += value[entry, 0] * voltage[other, 0] - value[entry, 1] * voltage[other, 1]
            imaginary += value[entry, 0] * voltage[other, 1] + value[entry, 1] * voltage[other, 0]
        power[node, 0] = voltage[node, 0] * real + voltage[node, 1] * imaginary
        power[node, 1] = voltage[node, 1] * real - voltage[node, 0] * imaginary
        unknown = first_unknown[node]
        difference = power[node, 0] - injection[node, 0]
        step[unknown] = difference
        worst = max(worst, abs(difference))
        spoiled += 0.0 * difference
        if first_unknown[node + 1] - unknown == 2:
            difference = power[node, 1] - injection[node, 1]
            step[unknown + ONE] = difference
            worst = max(worst, abs(difference))
            spoiled += 0.0 * difference
    return worst + spoiled


@borrowing_jit
def fill_jacobian(equations: Equations, factors: Factors) -> None:
    """Derivatives of the power at the present voltages."""
    first, column, value = equations.admittance_first, equations.admittance_node, equations.admittance
    voltage, power, n_free = equations.voltage, equations.power, equations.n_free
    first_unknown, block, panel = equations.first_unknown, equations.admittance_panel, factors.panel
    for k in range(factors.first_panel[n_free]):
        panel[k] = 0.0
    for node in range(n_free):
        e, f = voltage[node, 0], voltage[node, 1]
        rows = first_unknown[node + 1] - first_unknown[node]
        for entry in range(first[node], first[node + 1]):
            other = column[entry]
            if other >= n_free:
                continue
            real = value[entry, 0] * voltage[other, 0] - value[entry, 1] * voltage[other, 1]
            imaginary = value[entry, 0] * voltage[other, 1] + value[entry, 1] * voltage[other, 0]
            along = e * real + f * imaginary
            across = f * real - e * imaginary
            p_angle, p_magnitude, q_angle, q_magnitude = across, along, -along, across
            if other == node:
                p_angle -= power[node, 1]
                p_magnitude += power[node, 0]
                q_angle += power[node, 0]
                q_magnitude += power[node, 1]
            at = np.uint64(block[entry])
            columns = first_unknown[other + ONE] - first_unknown[other]
            panel[at] = p_angle
            if rows == 2:
                panel[at + ONE] = q_angle
            if columns == 2:
                panel[at + np.uint64(rows)] = p_magnitude
                if rows == 2:
                    panel[at + THREE] = q_magnitude


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
        u = first_unknown[node]
        turned = angle[node] - step[u]
        if first_unknown[node + 1] - u == 2:
            size = magnitude[node] * (1.0 - step[u + ONE])
            if size < 0.0:
                size = -size
                turned += math.pi
            magnitude[node] = size
        if abs(turned) > math.pi:
            turned -= 2.0 * math.pi * ((turned * (0.5 / math.pi) + _ROUND) - _ROUND)
        angle[node] = turned
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
    if not factorise(factors):
        return False
    step, angle = equations.step, equations.angle
    solve(factors, step)
    for node in range(equations.n_free):
        angle[node] = step[equations.first_unknown[node]]
    angle[equations.n_free] = 0.0
    write_voltage(equations)
    tolerance = network.tolerance[0]
    mismatch = measure_mismatch(equations)
    ratio = math.inf
    for iteration in range(network.max_iterations[0]):
        if mismatch < tolerance:
            _drop_anchor(flow, i, iteration)
            return True
        if not math.isfinite(mismatch):
            return False
        # So close to the solution the last factors do as well as new ones, and a full step would surely converge.
        if iteration > _TRUSTED_STEPS or not mismatch * (4.0 * ratio) ** 2 < tolerance:
            fill_jacobian(equations, factors)
            if not factorise(factors):
                return False
        solve(factors, equations.step)
        apply_step(equations)
        before = mismatch
        mismatch = measure_mismatch(equations)
        ratio = mismatch / before
    if not mismatch < tolerance:
        return False
    _drop_anchor(flow, i, network.max_iterations[0])
    return True


@borrowing_jit
def _drop_anchor(flow: FlowState, i: int, n_steps: int) -> None:
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
    if flow.anchor_steps[i] > _TRUSTED_STEPS:
        return False
    if _change_setpoints(equations, flow.gen_node[i], gen_v):
        write_voltage(equations)
    tolerance = network.tolerance[0]
    mismatch = measure_mismatch(equations)
    ratio = 0.0
    for step in range(_WARM_STEPS):
        if mismatch < tolerance:
            return _is_near_anchor(equations, flow.anchor[i])
        if not ratio < _SLOWEST:
            return False
        # Factors of the last call do for the first step; then new ones, unless three steps more will do.
        if step > 0 and not mismatch * ratio**3 < tolerance:
            fill_jacobian(equations, factors)
            if not factorise(factors):
                return False
        solve(factors, equations.step)
        apply_step(equations)
        before = mismatch
        mismatch = measure_mismatch(equations)
        ratio = mismatch / before
    return bool(mismatch < tolerance) and _is_near_anchor(equations, flow.anchor[i])


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
        far |= abs(magnitude[node] - anchor[node, 0]) > _MAGNITUDE_RANGE
        far |= abs(angle[node] - anchor[node, 1]) > _ANGLE_RANGE
    return not far
