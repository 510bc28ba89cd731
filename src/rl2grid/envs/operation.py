"""What an episode has cost so far, as the L2RPN competitions count it; see :mod:`rl2grid.mdp.operation`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rl2grid.mdp import state as columns
from rl2grid.mdp.state import GridState
from rl2grid.scenarios.episodes import EpisodePlan
from rl2grid.scenarios.library import open_series
from rl2grid.scenarios.scenario import Scenario

_TENTH = 0.1
"""MW: the unit of the months of training."""


@dataclass(frozen=True)
class Operation:
    """Sums over an episode."""

    cost_losses: float
    """Of losses, at the price of the dearest generator that produces."""
    cost_redispatch: float
    """Of redispatch, at that price."""
    cost_curtailment: float
    """Of curtailment that is added; what is taken back is given back."""
    cost_storage: float
    """Of the use of storage, at that price."""
    cost_blackout: float
    """Of a game over: the demand of all later steps, MW, at the price of the grid's dearest generator."""
    storage_energy: float
    """MWh that storage took in and gave out."""
    renewable_used: float
    """MWh produced by renewables."""
    renewable_available: float
    """MWh that they would have produced without limits."""


def operation_of(state: GridState, i: int, grid_id: str, plan: EpisodePlan) -> Operation:
    """What the episode of row ``i`` has cost so far."""
    sums = state.episode_operation[i]
    lost = 0.0
    if state.terminated[i]:
        lost = demand(grid_id, plan, int(state.step[i]) + 1) * float(state.gen_cost_per_mw.max())
    return Operation(
        cost_losses=float(sums[columns.LOSSES_COST]),
        cost_redispatch=float(sums[columns.REDISPATCH_COST]),
        cost_curtailment=float(sums[columns.CURTAILMENT_COST]),
        cost_storage=float(sums[columns.STORAGE_COST]),
        cost_blackout=lost,
        storage_energy=float(sums[columns.STORAGE_ENERGY]),
        renewable_used=float(sums[columns.RENEWABLE_USED]),
        renewable_available=float(sums[columns.RENEWABLE_AVAILABLE]),
    )


def demand(grid_id: str, plan: EpisodePlan, first: int = 1) -> float:
    """Sum of the demand of all loads over the steps of an episode from step ``first`` on, MW."""
    series = open_series(grid_id, plan.scenario_id)
    rows = slice(plan.start + first, plan.start + plan.n_steps + 1)
    if isinstance(series, Scenario):
        return float(series.load_p[rows].sum(dtype=np.float64))
    return _TENTH * float(series.rows(rows.start, rows.stop)[0].sum(dtype=np.float64))
