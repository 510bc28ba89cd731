"""What operating the grid costs, as the L2RPN competitions count it: sums over an episode.

A step costs what its losses, its redispatch, the curtailment that it adds and its use of storage are worth, at the
price of the dearest generator that produces: Grid2Op's ``L2RPNSandBoxScore``, for the scores of 2020, 2021 and 2023. In
2022 storage had a price of its own (``L2RPNWCCI2022ScoreFun``). How a score follows from such sums is in
``rl2grid/records/l2rpn.py``, and in ``docs/l2rpn.md``.

The last step of an episode does not count, completed or not: the competitions leave it out.
"""

from __future__ import annotations

import numpy as np

from rl2grid.compile import jit
from rl2grid.grids import STEPS_PER_HOUR
from rl2grid.mdp.rewards import magnitude, marginal_cost, total
from rl2grid.mdp.state import (
    CURTAILMENT_COST,
    LOSSES_COST,
    REDISPATCH_COST,
    RENEWABLE_AVAILABLE,
    RENEWABLE_USED,
    STORAGE_COST,
    STORAGE_ENERGY,
    GridState,
)

_HOURS = 1.0 / STEPS_PER_HOUR
"""Of a step."""


@jit
def accrue_operation(state: GridState, i: int) -> None:
    """Add the grid step that row ``i`` has just made to the sums of its episode."""
    if state.terminated[i] or state.truncated[i]:
        return
    sums, price = state.episode_operation[i], _HOURS * marginal_cost(state.gen_p[i], state.gen_cost_per_mw)
    stored, curtailed = magnitude(state.storage_power[i]), _curtailed(state, i)
    sums[LOSSES_COST] += price * (total(state.gen_p[i]) - total(state.load_p[i]))
    sums[REDISPATCH_COST] += price * magnitude(state.actual_dispatch[i])
    # Grid2Op counts what is curtailed more than in the step before, and gives back what is curtailed less.
    sums[CURTAILMENT_COST] += price * (curtailed - state.curtailed[i])
    sums[STORAGE_COST] += price * stored
    sums[STORAGE_ENERGY] += _HOURS * stored
    state.curtailed[i] = curtailed
    for gen in range(state.gen_p.shape[1]):
        if state.gen_renewable[gen]:
            sums[RENEWABLE_USED] += _HOURS * np.float64(state.gen_p[i, gen])
            sums[RENEWABLE_AVAILABLE] += _HOURS * np.float64(state.gen_p_before_curtail[i, gen])


@jit
def _curtailed(state: GridState, i: int) -> float:
    """MW that the limits keep renewables from producing."""
    power = 0.0
    for gen in range(state.gen_p.shape[1]):
        if state.gen_renewable[gen]:
            limit = np.float64(state.curtailment_limit[i, gen]) * np.float64(state.gen_pmax[gen])
            power += max(np.float64(state.gen_p_before_curtail[i, gen]) - limit, 0.0)
    return power
