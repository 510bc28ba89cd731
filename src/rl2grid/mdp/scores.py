"""The three operational scores of a grid step (paper, Section 5), reported beside the reward.

All are 0 in the step of a game over: no flow was found, so there is nothing to score.
"""

from __future__ import annotations

import numpy as np

from rl2grid.compile import jit
from rl2grid.mdp.rewards import overload_component
from rl2grid.mdp.state import GridState

SCORES: tuple[str, ...] = ("margin", "overload", "topology")
"""Names of the scores, in the order of :attr:`GridState.episode_scores`."""


@jit
def margin_score(state: GridState, i: int) -> float:
    """Sum over lines of the free capacity ``max(0, 1 - rho)``, and -1 for a disconnected line.

    The paper prints ``max(0, P_max - |P|)``. Margins are taken relative to each line's own limit here:
    limits are currents at different voltages, whose differences in A cannot be added up, and -1 for a
    disconnected line has a meaning only beside margins that lie between 0 and 1.
    """
    if state.terminated[i]:
        return 0.0
    total = 0.0
    for line in range(state.rho.shape[1]):
        if state.line_status[i, line]:
            total += max(0.0, 1.0 - np.float64(state.rho[i, line]))
        else:
            total -= 1.0
    return total


@jit
def overload_score(state: GridState, i: int) -> float:
    """The overload component of the default reward, in [-1, 0]: 0 without overload and disconnection."""
    return overload_component(state, i)


@jit
def topology_score(state: GridState, i: int) -> float:
    """Minus the number of elements that are not on busbar 1 (disconnected ones included)."""
    if state.terminated[i]:
        return 0.0
    elsewhere = 0
    for element in range(state.topo_vect.shape[1]):
        elsewhere += state.topo_vect[i, element] != 1
    return 0.0 - np.float64(elsewhere)
