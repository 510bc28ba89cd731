"""The recovery heuristic's decisions, as an agent (paper, Section 3.2)."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from rl2grid.agents.agent import Action, Info, Observation, has_topology_actions, topology_action
from rl2grid.errors import UsageError
from rl2grid.handles import AsOpened
from rl2grid.mdp.actions import ActionKind, full_catalogue
from rl2grid.mdp.heuristics import is_safe, recovery_action
from rl2grid.mdp.state import GridState

_NOTHING = 0


class Recovery:
    """While the grid is safe, brings it back to its reference topology, one action per step; else does nothing.

    It plays with the actions of the task: where the step that the heuristic would take is not among
    them (the lower levels leave most out), it does nothing. On joint tasks it never injects.
    """

    name = "recovery"
    kinds = ("T", "H")

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Index the actions of the task, and remember the environment, whose state is looked at.

        Raises:
            UsageError: the task has no topology actions.
        """
        if not has_topology_actions(env.action_space):
            raise UsageError(
                "Agent 'recovery' cannot play a redispatching task (-R-), which has no topology actions: "
                "choose a topology task (-T0-, -T1-, ...) or the keyword heuristic='recovery'."
            )
        base: Any = env.unwrapped
        self._env, self._space = base, env.action_space
        self._opened: AsOpened[GridState] = AsOpened()
        actions = full_catalogue(base.grid).take(base.action_catalogue_ids)
        keys = zip(actions.kind.tolist(), actions.target.tolist(), actions.masks(), strict=True)
        self._action = {key: action for action, key in enumerate(keys)}

    def reset(self, i: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation, info: Info) -> Action:
        """The heuristic's action; the one that changes nothing where it would idle or the task lacks that action."""
        return topology_action(self._space, self.choose())

    def choose(self) -> int:
        """The id of the heuristic's action, 0 where it would idle or the task lacks that action."""
        state: GridState = self._env.state
        opened = self._opened(state)
        if not is_safe(opened, 0):
            return _NOTHING
        kind, target = recovery_action(opened, 0)
        if kind == ActionKind.RECONNECT:
            return self._action.get((int(ActionKind.SWITCH), int(target), 0), _NOTHING)
        if kind == ActionKind.RESTORE:
            mask = _on_second_busbar(state, int(target))
            return self._action.get((int(ActionKind.MOVE), int(target), mask), _NOTHING)
        return _NOTHING


def _on_second_busbar(state: GridState, sub: int) -> int:
    """The elements of a substation that sit on busbar 2, as the mask of a move."""
    first, size = int(state.sub_first_element[sub]), int(state.sub_info[sub])
    busbars = state.topo_vect[0, first : first + size]
    return int(sum(1 << k for k in np.flatnonzero(busbars == 2).tolist()))
