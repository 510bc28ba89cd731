"""The costs of the constrained tasks (paper, Section 3.3); :mod:`rl2grid.mdp.constraint_table` lists them.

LSI (load shedding and islanding) is charged once, by the reason of a game over. TLO (transmission line
overload) counts lines that are overloaded or disconnected in a step, except those that the agent could not
keep in service: see :func:`update_excused`.
"""

from __future__ import annotations

import numpy as np

from rl2grid.compile import jit
from rl2grid.mdp.state import GridState
from rl2grid.mdp.termination import GameOver

_NONE, _DIVERGENCE, _DISPATCH = int(GameOver.NONE), int(GameOver.DIVERGENCE), int(GameOver.DISPATCH)


@jit
def update_excused(state: GridState, i: int) -> None:
    """Update, from the observation of a step, which lines TLO leaves out.

    A line is excused from the onset of an attack or of planned maintenance. The excuse ends when its
    reconnection first becomes legal: the observed cooldown is 0 and it is neither attacked nor in
    maintenance. Leaving it open from then on is the agent's choice.
    """
    for line in range(state.excused.shape[1]):
        begins = state.attacked[i, line] | (state.time_next_maintenance[i, line] == 0)
        lasts = state.excused[i, line] & (state.time_before_cooldown_line[i, line] != 0)
        state.excused[i, line] = begins | lasts


@jit
def lsi_cost(state: GridState, i: int) -> float:
    """Unmet demand plus disconnected components, of a step: 2, 1 or 0.

    A game over leaves demand unmet. When it comes from a load, generator or storage that is cut off, or
    from an island, a component is disconnected as well. The paper's two indicators cannot be read from the
    state before: while the grid is alive, demand is met and the grid is in one piece.
    """
    reason = state.game_over[i]
    if reason == _NONE:
        return 0.0
    if reason in (_DIVERGENCE, _DISPATCH):
        return 1.0
    return 2.0


@jit
def tlo_cost(state: GridState, i: int) -> float:
    """Number of lines that are overloaded (``rho > 1``) or disconnected in a step and not excused.

    It is 0 in the step of a game over, which has no flow: that step is LSI's to charge.
    """
    if state.terminated[i]:
        return 0.0
    count = 0
    for line in range(state.rho.shape[1]):
        lost = (not state.line_status[i, line]) | (state.rho[i, line] > np.float32(1.0))
        count += lost & (not state.excused[i, line])
    return np.float64(count)


@jit
def step_costs(state: GridState, i: int) -> tuple[float, ...]:
    """The costs of a step in the order of :data:`rl2grid.mdp.constraint_table.CONSTRAINTS`."""
    return lsi_cost(state, i), tlo_cost(state, i)
