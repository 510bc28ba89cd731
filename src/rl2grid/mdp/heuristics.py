"""What the grid does on its own while it is safe (paper, Section 3.2).

*Idle* does nothing. *Recovery* brings the grid back to its reference, one thing per step and without
looking ahead: :func:`recovery_action` on topology tasks, :func:`reconnect_action` on redispatching tasks.
"""

from __future__ import annotations

import numpy as np

from rl2grid.compile import jit
from rl2grid.mdp.actions import ActionKind
from rl2grid.mdp.state import GridState

SAFE_RHO = np.float32(0.95)
"""The grid is safe while every line is loaded strictly less; float32, as the loadings it is compared with."""

_NOTHING, _RECONNECT, _RESTORE = int(ActionKind.NOTHING), int(ActionKind.RECONNECT), int(ActionKind.RESTORE)


@jit
def is_safe(state: GridState, i: int) -> bool:
    """Whether every line of row ``i`` is loaded less than 95%: the heuristic plays, not the agent."""
    return bool(np.all(state.rho[i] < SAFE_RHO))


@jit
def recovery_action(state: GridState, i: int) -> tuple[int, int]:
    """The next step of the recovery heuristic in row ``i``, as (:class:`ActionKind`, target).

    Reconnect the lowest-numbered line that may legally be reconnected; else bring back the lowest-numbered
    substation that may legally be changed and has a connected element on busbar 2; else nothing.
    """
    kind, line = reconnect_action(state, i)
    if kind == _RECONNECT:
        return kind, line
    for sub in range(state.sub_info.shape[0]):
        first = state.sub_first_element[sub]
        busbars = state.topo_vect[i, first : first + state.sub_info[sub]]
        if state.time_before_cooldown_sub[i, sub] == 0 and np.any(busbars == 2):
            return _RESTORE, sub
    return _NOTHING, 0


@jit
def reconnect_action(state: GridState, i: int) -> tuple[int, int]:
    """Reconnect the lowest-numbered line that may legally be reconnected in row ``i``; else nothing."""
    for line in range(state.line_status.shape[1]):
        if not state.line_status[i, line] and state.time_before_cooldown_line[i, line] == 0:
            return _RECONNECT, line
    return _NOTHING, 0
