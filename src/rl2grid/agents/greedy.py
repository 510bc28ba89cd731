"""Greedy search: try every action on the forecast, play the one that leaves the largest margin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from rl2grid.agents.agent import Action, Info, Observation
from rl2grid.agents.recovery import Recovery
from rl2grid.errors import UsageError
from rl2grid.mdp.heuristics import SAFE_RHO, is_safe

_NOTHING = 0
_WORTHWHILE = 1e-3
"""Least decrease of the worst loading for which an action is played."""


class Greedy:
    """While the grid is not safe, plays the action with the lowest worst loading in the next step, by its forecast.

    All actions are tried at once with the AC power flow (:meth:`PowerGridEnv.what_if`). While the grid is safe, it
    plays what :class:`Recovery` plays, if the forecast then stays safe. It knows neither the opponent's next attack nor
    what comes after the next step.

    Args:
        actions: ids that it may play, do nothing always being one of them; None: all of the task.
    """

    name = "greedy"

    def __init__(self, actions: Sequence[int] | None = None) -> None:
        self._recovery = Recovery()
        self._actions = None if actions is None else [_NOTHING, *sorted(set(actions) - {_NOTHING})]

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Remember the environment, which is asked for forecasts.

        Raises:
            UsageError: the task has no topology actions.
        """
        if not isinstance(env.action_space, gymnasium.spaces.Discrete):
            raise UsageError(
                "Agent 'greedy' cannot play a redispatching task (-R-), which has no topology actions: "
                "choose a topology task (-T0-, -T1-, ...)."
            )
        self._env: Any = env.unwrapped
        self._recovery.bind(env)

    def reset(self, i: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation, info: Info) -> Action:
        """The id of the best action; 0 where none is better than doing nothing."""
        if is_safe(self._env.state, 0):
            return self._recover(observation, info)
        outcomes = self._env.what_if(self._actions)
        loading = np.where(outcomes.legal, outcomes.worst_loading, np.inf)
        best = int(loading.argmin())
        if not loading[best] < loading[_NOTHING] - _WORTHWHILE:
            return _NOTHING
        return best if self._actions is None else self._actions[best]

    def _recover(self, observation: Observation, info: Info) -> Action:
        """The recovery heuristic's action, if it keeps the grid as safe as the heuristic asks."""
        action = self._recovery.act(observation, info)
        if action == _NOTHING or (self._actions is not None and action not in self._actions):
            return _NOTHING
        worst = self._env.what_if([action]).worst_loading[0]
        return action if worst < SAFE_RHO else _NOTHING
