"""Greedy search for a topology action and an injection together (``docs/algorithms/greedy.md``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium

from rl2grid.agents.agent import Action, Considered, Info, Observation, injecting_action, topology_action
from rl2grid.agents.dispatch import worst_loading
from rl2grid.agents.greedy_dispatch import GreedyDispatch
from rl2grid.agents.greedy_topology import GreedyTopology
from rl2grid.errors import UsageError
from rl2grid.handles import AsOpened
from rl2grid.mdp.heuristics import SAFE_RHO, is_safe
from rl2grid.mdp.state import GridState

_NOTHING = 0


class GreedyJoint:
    """Plays what :class:`GreedyTopology` chooses, and with it what :class:`GreedyDispatch` finds for what is left.

    While the grid is not safe, a topology action that makes it safe by its forecast is played alone; else the dispatch
    is searched for with that topology action, or with none, as part of every candidate. While the grid is safe, what is
    dispatched is given back.

    Args:
        actions: ids of the topology actions that it may play, do nothing always being one of them; None: all.
    """

    name = "greedy"
    kinds = ("H",)

    def __init__(self, actions: Sequence[int] | None = None) -> None:
        self._topology, self._dispatch = GreedyTopology(actions), GreedyDispatch()

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Remember the environment, which is asked for forecasts.

        Raises:
            UsageError: the task is not a joint one.
        """
        if not isinstance(env.action_space, gymnasium.spaces.Dict):
            raise UsageError("A topology action and a dispatch are searched for on joint tasks (-H0-, ...) only.")
        self._env: Any = env.unwrapped
        self._opened: AsOpened[GridState] = AsOpened()
        self._space = env.action_space
        self._topology.bind(env)
        self._dispatch.bind(env)

    def reset(self, i: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation, info: Info) -> Action:
        """The topology action, and the injection that goes with it."""
        chosen = self._topology.choose()
        self._alone = chosen != _NOTHING and not self._is_safe() and self._is_enough(chosen)
        if self._alone:
            return topology_action(self._space, chosen)
        return injecting_action(self._space, self._dispatch.choose(chosen), chosen)

    def explain(self) -> Considered | None:
        """What was tried and by what rule the action was chosen."""
        return (None if self._alone else self._dispatch.explain()) or self._topology.explain()

    def ranking(self, most: int) -> Considered | None:
        """The topology actions with the least worst loading by the forecast, nothing being dispatched."""
        return self._topology.ranking(most)

    def _is_safe(self) -> bool:
        return bool(is_safe(self._opened(self._env.state), 0))

    def _is_enough(self, chosen: int) -> bool:
        return bool(worst_loading(self._env, topology_action(self._space, chosen)) < SAFE_RHO)
