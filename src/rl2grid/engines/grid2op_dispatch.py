"""Redispatch as Grid2Op solves it: an iterative solver, stopped early.

:mod:`rl2grid.engines.dispatch` solves the same programme to optimality. Results that are to equal those of
an unmodified Grid2Op environment need this one, for the early stop leaves the solution at a place that depends
on the path: on the starting point, the scaling and the rounding of each operation. They are therefore those of
``grid2op.Environment.dispatch.DefaultRedispatchSolver`` (Grid2Op 1.12.6), in its order: limits in float32,
the programme in float64, SciPy's SLSQP with the same tolerances.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rl2grid.arrays import F32, F64, Flags
from rl2grid.engines.dispatch import EPSILON, NEGLIGIBLE, TOLERANCE

_LEAST_PRECISION = 1e-6
_LEAST_SUM_OF_WEIGHTS = 1e-2
_SLACK = 0.5 * EPSILON


class _Programme(NamedTuple):
    """The quadratic programme over the participating generators, scaled; see :func:`find_dispatch_grid2op`."""

    goal: F64  # [costly]
    costly: Flags  # [participant]
    weight: F64  # [participant]
    lower: F64  # [participant]
    upper: F64  # [participant]
    total: float
    start: F64  # [participant]
    scale: float
    """MW per unit of the other values."""
    scale_objective: float


def find_dispatch_grid2op(
    new_p: F32,
    setpoint: F32,
    target: F32,
    actual: F32,
    modified: Flags,
    pmin: F32,
    pmax: F32,
    ramp_up: F32,
    ramp_down: F32,
    redispatchable: Flags,
    power: float,
    out: F32,
) -> bool:
    """Write Grid2Op's new ``actual_dispatch`` to ``out``; False (a game over) if it finds none.

    Arguments as in :func:`rl2grid.engines.dispatch.find_dispatch`; not compiled. The result is
    near the optimum in the objective only: single generators may be some MW from theirs.
    """
    power = float(power)  # a NumPy scalar would decide on the precision of what it is added to
    rise = new_p - (setpoint - actual)
    members = redispatchable & ((new_p > 0) | (np.abs(actual) >= NEGLIGIBLE) | (target != actual))
    if not _can_balance(rise, setpoint, pmin, pmax, ramp_up, ramp_down, members, power):
        members = redispatchable
        if not _can_balance(rise, setpoint, pmin, pmax, ramp_up, ramp_down, members, power):
            return False
    planned = new_p + actual
    lower = np.maximum(pmin - planned, -ramp_down - rise)[members].astype(np.float64)
    upper = np.minimum(pmax - planned, ramp_up - rise)[members].astype(np.float64)
    flexibility = ramp_up + ramp_down + EPSILON
    programme = _scale(target, actual, modified, members, flexibility, lower - _SLACK, upper + _SLACK, power)
    change = _solve(programme)
    if change is None:
        return False
    result = actual.copy()
    result[members] += change * programme.scale
    out[:] = result
    return True


def _can_balance(
    rise: F32,
    setpoint: F32,
    pmin: F32,
    pmax: F32,
    ramp_up: F32,
    ramp_down: F32,
    members: Flags,
    power: float,
) -> bool:
    """Whether ``members`` can together follow the time series and produce ``power`` MW more."""
    move = rise[members].sum() + power
    # Infeasible is what is proved to be: with NaN, Grid2Op goes on to the solver.
    too_much = move > np.minimum(pmax - setpoint, ramp_up)[members].sum()
    too_little = move < np.maximum(pmin - setpoint, -ramp_down)[members].sum()
    return not (too_much or too_little)


def _scale(
    target: F32,
    actual: F32,
    modified: Flags,
    members: Flags,
    flexibility: F32,
    lower: F64,
    upper: F64,
    power: float,
) -> _Programme:
    """The programme in units that suit the solver, with its starting point."""
    weight = (1.0 / flexibility)[members].astype(np.float64)
    weight /= weight.sum()
    costly = modified[members]
    if not costly.any():
        costly[:] = True
    scale = float(max(np.max(np.abs(actual)), 1.0))
    wanted = target[members] - actual[members]
    goal = (wanted[costly] / scale).astype(np.float64)
    scale_objective = float(np.round(max(0.5 * np.abs(goal).sum() ** 2, 1.0), decimals=4))
    if (np.abs(target) >= NEGLIGIBLE).any() or modified.any():
        asked = (np.abs(target) >= NEGLIGIBLE)[members] | modified[members]
        start = _balanced_start(np.where(asked, wanted / scale, 0.0), weight)
    else:
        start = (-(actual[members] / scale)).astype(np.float64)
    return _Programme(goal, costly, weight, lower / scale, upper / scale, power / scale, start, scale, scale_objective)


def _balanced_start(start: F64, weight: F64) -> F64:
    """``start`` in float64 with its zeros replaced, in proportion to the ramps, so that it sums to zero."""
    start = start.astype(np.float64)
    free = np.abs(start) <= 1e-7
    if not free.any():
        return start
    total = start.sum()
    ramps = (1.0 / weight[free]).sum()
    if ramps <= _LEAST_SUM_OF_WEIGHTS:
        ramps = 1.0
    start[free] = -total / (weight[free] * ramps)
    return start


def _solve(programme: _Programme) -> F64 | None:
    """What the solver returns if it converged or respects the constraints nearly; else None."""
    from scipy.optimize import minimize  # slow to import and not needed by the exact dispatch

    goal, costly, lower, upper = programme.goal, programme.costly, programme.lower, programme.upper
    size = costly.size
    costly_weight = programme.weight[costly]
    sums, signs = np.ones((1, size)), np.concatenate((np.eye(size), -np.eye(size)))

    def objective(x: F64) -> float:
        return float((costly_weight * (x[costly] - goal) ** 2).sum() / programme.scale_objective)

    def gradient(x: F64) -> F64:
        slope = np.zeros(size)
        slope[costly] = 2.0 * costly_weight * (x[costly] - goal)
        return slope / programme.scale_objective

    precision = max(float(EPSILON / programme.scale), _LEAST_PRECISION)
    found = minimize(
        objective,
        programme.start,
        method="SLSQP",
        jac=gradient,
        constraints=[
            {"type": "eq", "fun": lambda x: np.dot(sums, x) - programme.total, "jac": lambda x: sums},
            {"type": "ineq", "fun": lambda x: np.concatenate((x - lower, -(x - upper))), "jac": lambda x: signs},
        ],
        options={"ftol": precision},
    )
    change: F64 = found.x
    if found.success:
        return change
    values = np.append(np.matmul(sums, change), change)
    near_lower = values - np.append(programme.total, lower) >= -TOLERANCE
    near_upper = values - np.append(programme.total, upper) <= TOLERANCE
    return change if near_lower.all() and near_upper.all() else None
