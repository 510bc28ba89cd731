"""Which engine is nearer to the exact flow, where they differ by more than the tolerance that parity admits.

``python benchmarks/exact_flow.py [--grid G] [--kind K] [--policy P] [--dispatch D] [--episode N] [--step S]
[--horizon H]`` plays an episode of ``benchmarks/parity.py`` up to a step on both engines, simulates doing nothing, and
solves the power flow of that forecast once more, with dense matrices. It prints the lines that differ most. The
defaults are the one disagreement of ten million steps that the comparison could not explain (``docs/parity.md``).
"""

from __future__ import annotations

import argparse
import math

import numpy as np
import parity
from numpy.typing import NDArray

from rl2grid.engines.differential import SideBySide
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.mdp.actions import DO_NOTHING
from rl2grid.powerflow.flow_state import ABSENT, FlowState
from rl2grid.powerflow.model import Network
from rl2grid.scenarios.cache import data_folder

_STEPS = 5
"""Of Newton's method, from the native engine's voltages."""

Complex = NDArray[np.complex128]


def admittance(flow: FlowState) -> Complex:
    """The matrix of row 0, complex128 [node, node]."""
    n = int(flow.n_node[0])
    matrix = np.zeros((n, n), np.complex128)
    for node in range(n):
        entries = slice(int(flow.admittance_first[0][node]), int(flow.admittance_first[0][node + 1]))
        matrix[node, flow.admittance_node[0][entries]] = flow.admittance[0][entries] @ (1.0, 1.0j)
    return matrix


def solved(flow: FlowState) -> tuple[Complex, float]:
    """Voltages of the exact flow of row 0, per unit, and the largest mismatch that the native engine left."""
    y, n = admittance(flow), int(flow.n_node[0])
    voltage = flow.voltage[0, :n] @ (1.0, 1.0j)
    injection = flow.injection[0, :n] @ (1.0, 1.0j)
    free = np.arange(n - 1)
    loads = free[np.diff(flow.first_unknown[0][:n].astype(np.int64)) == 2]
    size, angle = np.abs(voltage), np.angle(voltage)
    left = math.nan
    for step in range(_STEPS):
        voltage = size * np.exp(1j * angle)
        current = y @ voltage
        mismatch = voltage * current.conj() - injection
        wrong = np.r_[mismatch[free].real, mismatch[loads].imag]
        left = float(np.abs(wrong).max()) if step == 0 else left
        by_angle = 1j * np.diag(voltage) @ (np.diag(current) - y @ np.diag(voltage)).conj()
        by_size = np.diag(voltage) @ (y @ np.diag(voltage / size)).conj() + np.diag(current.conj() * voltage / size)
        real = np.c_[by_angle[np.ix_(free, free)], by_size[np.ix_(free, loads)]].real
        imaginary = np.c_[by_angle[np.ix_(loads, free)], by_size[np.ix_(loads, loads)]].imag
        moved = np.linalg.solve(np.r_[real, imaginary], wrong)
        angle[free] -= moved[: n - 1]
        size[loads] -= moved[n - 1 :]
    return size * np.exp(1j * angle), left


def currents(network: Network, flow: FlowState, voltage: Complex) -> NDArray[np.float64]:
    """At the origins of all lines, A, 0 on open ones."""
    found = np.zeros(len(network.line_admittance))
    for line, (origin, extremity) in enumerate(zip(flow.line_or_node[0], flow.line_ex_node[0], strict=True)):
        if origin == ABSENT:
            continue
        own, other = network.line_admittance[line, :4].reshape(2, 2) @ (1.0, 1.0j)
        kilovolt = network.nominal_voltage[network.line_or_sub[line]]
        megavolt_ampere = abs(own * voltage[origin] + other * voltage[extremity]) * network.base_power[0]
        found[line] = 1e3 * megavolt_ampere / (math.sqrt(3.0) * kilovolt)
    return found


def forecast_of(native: NativeEngine) -> FlowState:
    """The flow that was simulated last."""
    return native._simulated.structure.flow


def main() -> None:
    """Play, simulate, solve and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grid", default="bus118-MOB-v1")
    parser.add_argument("--kind", default="joint")
    parser.add_argument("--policy", default="within limits")
    parser.add_argument("--dispatch", default="exact", choices=("exact", "grid2op"))
    parser.add_argument("--episode", type=int, default=2_000_616)
    parser.add_argument("--step", type=int, default=33)
    parser.add_argument("--horizon", type=int, default=11)
    arguments = parser.parse_args()
    reference, native = parity.engines(arguments.grid, arguments.dispatch)
    pair = SideBySide(reference, native, dispatch=arguments.dispatch)
    policies = data_folder() / "parity" / "policies"
    probe = parity.probe_of(arguments.grid, arguments.kind, arguments.policy, policies)
    pair.play(parity.plan(native.grid, 0, arguments.episode), probe, arguments.step)
    theirs, ours = (engine.simulate(0, DO_NOTHING, arguments.horizon) for engine in (reference, native))
    flow = forecast_of(native)
    exact, left = solved(flow)
    amperes = currents(native.network, flow, exact)
    apart = np.abs(theirs.a_or[0].astype(np.float64) - ours.a_or[0])
    print(
        f"lowest voltage {np.abs(exact).min():.3f}, worst loading {ours.rho[0].max():.3f}, our mismatch {left:.1e} MVA"
    )
    print("line, A: LightSim2Grid, ours, exact")
    for line in np.argsort(-apart)[:6]:
        print(f"{line}: {theirs.a_or[0, line]:.6f} {ours.a_or[0, line]:.6f} {amperes[line]:.6f}")
    for name, state in (("LightSim2Grid", theirs), ("ours", ours)):
        print(f"{name}: {np.abs(state.a_or[0] - amperes).max():.1e} A from the exact flow at most")


if __name__ == "__main__":
    main()
