"""Redispatch: the generators' answer to the agent, solved exactly.

At each step the generators have to produce ``power`` MW more than the time series, because of
storage and curtailment, as near as possible to the dispatch that the agent asked for, within their
limits and ramps. Grid2Op poses this as a quadratic programme
(``grid2op.Environment.dispatch.DefaultRedispatchSolver``) and stops an iterative solver early. Here
the same programme is solved to optimality: it is separable but for one sum, so its solution is
``clip(goal + multiplier * flexibility, lower, upper)`` and only the multiplier is sought.

Arithmetic that builds the programme and decides on its feasibility is float32, operation by
operation that of Grid2Op, so that both agree on when a game is over; the solution is float64.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F32, F64, Flags
from rl2grid.compile import jit

TOLERANCE = np.float32(1e-2)
"""MW below which nothing has to be dispatched (``BaseEnv._tol_poly``)."""
EPSILON = np.float32(1e-4)
"""MW by which the bounds are relaxed, half on each side (``BaseEnv._epsilon_poly``)."""
NEGLIGIBLE = np.float32(1e-7)
"""MW below which a request or a dispatch counts as none."""

_SLACK = np.float64(np.float32(0.5) * EPSILON)
_UNROLLED = 8


@jit
def redispatch_is_impossible(request: F32, target: F32, actual: F32, modified: Flags, pmin: F32, pmax: F32) -> bool:
    """Whether ``request`` would bring a target out of reach, further than ``pmax - pmin`` from zero.

    Grid2Op then forgets the request but keeps the topology of the same action, and gets storage
    wrong (``BaseEnv._prepare_redisp``).

    Args:
        request: MW asked of each generator by the action (``BaseAction._redispatch``), float32.
        target: ``target_dispatch``, MW.
        actual: ``actual_dispatch``, MW.
        modified: generators that were ever redispatched in the episode
            (``BaseEnv._already_modified_gen``).
        pmin: lowest production, MW.
        pmax: highest production, MW.
    """
    for gen in range(request.size):
        goal = target[gen]
        if modified[gen]:
            goal = goal + request[gen]
        elif abs(request[gen]) > NEGLIGIBLE:
            goal = actual[gen] + request[gen]
        if goal > pmax[gen] - pmin[gen] or goal < pmin[gen] - pmax[gen]:
            return True
    return False


@jit
def add_request(request: F32, target: F32, actual: F32, modified: Flags) -> None:
    """Add ``request`` to ``target`` in place and mark its generators in ``modified``.

    A generator's first request counts from where the generator is, later ones from its target
    (``BaseEnv._get_already_modified_gen``). Arguments as in :func:`redispatch_is_impossible`.
    """
    for gen in range(request.size):
        asked = abs(request[gen]) > NEGLIGIBLE
        if modified[gen]:
            target[gen] += request[gen]
        elif asked:
            target[gen] = actual[gen] + request[gen]
        if asked:
            modified[gen] = True


@jit
def dispatch_is_needed(actual: F32, target: F32, storage: float, curtailment: float) -> bool:
    """Whether anything has to be dispatched in this step (``BaseEnv._make_redisp``).

    Args:
        actual: ``actual_dispatch``, MW, float32.
        target: ``target_dispatch``, MW, float32.
        storage: change of the power that storage units absorb, MW.
        curtailment: change of the curtailed power, MW (negative: more is curtailed).
    """
    if abs(np.float32(storage)) >= TOLERANCE or abs(np.float32(curtailment)) >= TOLERANCE:
        return True
    for gen in range(actual.size):
        if abs(actual[gen] - target[gen]) >= TOLERANCE:
            return True
    return bool(abs(rounded_sum(actual, actual.size)) >= TOLERANCE)


@jit
def find_dispatch(
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
    """Write the best feasible ``actual_dispatch`` to ``out``; False (a game over) if there is none.

    With x the change of the dispatch of the participating generators, M those ever redispatched
    (all, if none was) and f = ramp_up + ramp_down + epsilon: minimise the sum over M of
    ``(x - (target - actual))**2 / f``, subject to sum(x) = power and to each generator's limits and
    ramps. Generators outside M cost nothing, so the minimum is not unique: of all minimisers, the
    one with the smallest sum of ``x**2 / f`` is taken.

    All arrays are float32 or bool of shape [gen] and are left as they are; ``out`` may be
    ``actual`` itself.

    Args:
        new_p: production that the time series ask for, after curtailment, MW.
        setpoint: ``new_p + actual`` of the previous step, MW
            (``BaseEnv._gen_activeprod_t_redisp``).
        target: ``target_dispatch`` after the request of this step, MW.
        actual: ``actual_dispatch`` of the previous step, MW.
        modified: generators that were ever redispatched in the episode.
        pmin: lowest production, MW.
        pmax: highest production, MW.
        ramp_up: largest increase, MW per step.
        ramp_down: largest decrease, MW per step.
        redispatchable: generators that may be dispatched.
        power: MW that the dispatch has to produce more than in the previous step: change of storage
            power minus change of curtailed power.
        out: the new ``actual_dispatch``, MW; untouched if there is none.
    """
    members = np.empty(new_p.size, np.int64)
    size = _participants(new_p, target, actual, redispatchable, False, members)
    if not _can_balance(new_p, setpoint, actual, pmin, pmax, ramp_up, ramp_down, members[:size], power):
        size = _participants(new_p, target, actual, redispatchable, True, members)
        if not _can_balance(new_p, setpoint, actual, pmin, pmax, ramp_up, ramp_down, members[:size], power):
            return False
    costly = _costly_first(modified, members[:size])
    problem = np.empty((5, size))
    goal, flexibility, lower, upper, change = problem[0], problem[1], problem[2], problem[3], problem[4]
    for k in range(size):
        gen = members[k]
        planned = new_p[gen] + actual[gen]
        rise = new_p[gen] - (setpoint[gen] - actual[gen])
        lower[k] = np.float64(max(pmin[gen] - planned, -ramp_down[gen] - rise)) - _SLACK
        upper[k] = np.float64(min(pmax[gen] - planned, ramp_up[gen] - rise)) + _SLACK
        if not lower[k] <= upper[k]:
            return False
        goal[k] = np.float64(target[gen] - actual[gen]) if k < costly else 0.0
        flexibility[k] = np.float64(ramp_up[gen] + ramp_down[gen] + EPSILON)
    solve_programme(goal, flexibility, lower, upper, costly, np.float64(power), change)
    out[:] = actual
    for k in range(size):
        out[members[k]] = np.float32(np.float64(actual[members[k]]) + change[k])
    return True


@jit
def solve_programme(goal: F64, flexibility: F64, lower: F64, upper: F64, costly: int, total: float, out: F64) -> None:
    """The quadratic programme of :func:`find_dispatch` on plain numbers, all float64 of shape [n].

    Minimises the sum of ``(x - goal)**2 / flexibility`` over the first ``costly`` entries, subject to
    ``lower <= x <= upper`` and ``sum(x) == total``; of all minimisers, the one with the smallest sum
    of ``x**2 / flexibility``.

    The entries without cost can absorb any sum between their bounds. So the costly ones go to their
    goals, or as far as the others can balance, and the others then share what is left.

    Args:
        goal: wanted values of the costly entries; zero for the others.
        flexibility: inverse weights, positive.
        lower: least values.
        upper: greatest values, nowhere below ``lower``.
        costly: number of entries with a goal.
        total: the wanted sum; out of reach of the bounds, the nearest bounds are taken.
        out: the solution.
    """
    wanted, others_least, others_most = 0.0, 0.0, 0.0
    for k in range(costly):
        wanted += min(max(goal[k], lower[k]), upper[k])
    for k in range(costly, goal.size):
        others_least += lower[k]
        others_most += upper[k]
    share = min(max(wanted, total - others_most), total - others_least)
    _share_out(goal[:costly], flexibility[:costly], lower[:costly], upper[:costly], share, out[:costly])
    _share_out(goal[costly:], flexibility[costly:], lower[costly:], upper[costly:], total - share, out[costly:])


@jit
def _participants(
    new_p: F32, target: F32, actual: F32, redispatchable: Flags, every: bool, out: NDArray[np.int64]
) -> int:
    """Write the generators that take part in the dispatch to ``out`` and return how many they are."""
    size = 0
    for gen in range(new_p.size):
        in_use = new_p[gen] > 0 or abs(actual[gen]) >= NEGLIGIBLE or target[gen] != actual[gen]
        if redispatchable[gen] and (every or in_use):
            out[size] = gen
            size += 1
    return size


@jit
def _can_balance(
    new_p: F32,
    setpoint: F32,
    actual: F32,
    pmin: F32,
    pmax: F32,
    ramp_up: F32,
    ramp_down: F32,
    members: NDArray[np.int64],
    power: float,
) -> bool:
    """Whether ``members`` can together follow the time series and produce ``power`` MW more."""
    room = np.empty((3, members.size), np.float32)
    rise, down, up = room[0], room[1], room[2]
    for k in range(members.size):
        gen = members[k]
        rise[k] = new_p[gen] - (setpoint[gen] - actual[gen])
        down[k] = max(pmin[gen] - setpoint[gen], -ramp_down[gen])
        up[k] = min(pmax[gen] - setpoint[gen], ramp_up[gen])
    move = rounded_sum(rise, members.size) + np.float32(power)
    return bool(rounded_sum(down, members.size) <= move <= rounded_sum(up, members.size))


@jit
def rounded_sum(values: F32, size: int) -> np.float32:
    """``values[:size].sum()`` with the rounding of NumPy, which adds in eight parallel sums.

    NumPy does so up to 128 values, more than any grid here has generators.
    """
    total: np.float32 = np.float32(0.0)
    if size < _UNROLLED:
        for k in range(size):
            total += values[k]
        return total
    whole = size - size % _UNROLLED
    a, b, c, d, e, f, g, h = (
        values[0], values[1], values[2], values[3], values[4], values[5], values[6], values[7]
    )  # fmt: skip
    for k in range(_UNROLLED, whole, _UNROLLED):
        a, b, c, d = a + values[k], b + values[k + 1], c + values[k + 2], d + values[k + 3]
        e, f, g, h = e + values[k + 4], f + values[k + 5], g + values[k + 6], h + values[k + 7]
    total = ((a + b) + (c + d)) + ((e + f) + (g + h))
    for k in range(whole, size):
        total += values[k]
    return total


@jit
def _costly_first(modified: Flags, members: NDArray[np.int64]) -> int:
    """Move the generators of the objective to the front of ``members`` and return how many they are."""
    costly = 0
    for k in range(members.size):
        if modified[members[k]]:
            members[k], members[costly] = members[costly], members[k]
            costly += 1
    return costly if costly > 0 else members.size


@jit
def _share_out(goal: F64, flexibility: F64, lower: F64, upper: F64, total: float, out: F64) -> None:
    """Solve for entries that all have a goal.

    The optimum is ``clip(goal + multiplier * flexibility, lower, upper)``, whose sum is piecewise
    linear and increasing in the multiplier: the piece that holds ``total`` is found by bisection
    among the sorted breakpoints, and the multiplier on it by one division.
    """
    breakpoints = np.empty(2 * goal.size)
    for k in range(goal.size):
        breakpoints[2 * k] = (lower[k] - goal[k]) / flexibility[k]
        breakpoints[2 * k + 1] = (upper[k] - goal[k]) / flexibility[k]
    _sort(breakpoints)
    below, above = -1, breakpoints.size  # the sum is at most total at `below` and exceeds it at `above`
    while above - below > 1:
        middle = (below + above) // 2
        if _sum_at(goal, flexibility, lower, upper, breakpoints[middle]) <= total:
            below = middle
        else:
            above = middle
    left = breakpoints[below] if below >= 0 else -np.inf
    right = breakpoints[above] if above < breakpoints.size else np.inf
    fixed, moving = 0.0, 0.0
    for k in range(goal.size):
        if (upper[k] - goal[k]) / flexibility[k] <= left:
            fixed += upper[k]
        elif (lower[k] - goal[k]) / flexibility[k] >= right:
            fixed += lower[k]
        else:
            fixed += goal[k]
            moving += flexibility[k]
    multiplier = (total - fixed) / moving if moving > 0.0 else left
    multiplier = min(max(multiplier, left), right)
    for k in range(goal.size):
        out[k] = min(max(goal[k] + multiplier * flexibility[k], lower[k]), upper[k])


@jit
def _sum_at(goal: F64, flexibility: F64, lower: F64, upper: F64, multiplier: float) -> float:
    """The sum of ``clip(goal + multiplier * flexibility, lower, upper)``."""
    total = 0.0
    for k in range(goal.size):
        total += min(max(goal[k] + multiplier * flexibility[k], lower[k]), upper[k])
    return total


@jit
def _sort(values: F64) -> None:
    """Sort in place, by insertion: quickest for so few."""
    for k in range(1, values.size):
        value = values[k]
        place = k
        while place > 0 and values[place - 1] > value:
            values[place] = values[place - 1]
            place -= 1
        values[place] = value
