"""Greedy search: try the actions on the forecast, play the best one (``docs/algorithms/greedy.md``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium

from rl2grid.agents.agent import Action, Agent, Considered, ExplainingAgent, Info, Observation, RankingAgent
from rl2grid.agents.dispatch import REQUESTS_COUNTED
from rl2grid.agents.greedy_dispatch import GreedyDispatch
from rl2grid.agents.greedy_joint import GreedyJoint
from rl2grid.agents.greedy_topology import GreedyTopology
from rl2grid.errors import UsageError


class Greedy:
    """While the grid is not safe, plays the action with a low worst loading in the next step, by its forecast.

    :class:`GreedyTopology` chooses on topology tasks, :class:`GreedyDispatch` on redispatching tasks and
    :class:`GreedyJoint` on joint tasks. It knows neither the opponent's next attack nor what comes after the next step.

    Args:
        actions: ids of the topology actions that it may play, do nothing always being one of them; None: all of the
            task.
    """

    name = "greedy"
    rules: ClassVar[Mapping[str, int]] = REQUESTS_COUNTED

    def __init__(self, actions: Sequence[int] | None = None) -> None:
        self._actions = actions

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Remember the environment, which is asked for forecasts.

        Raises:
            UsageError: actions to choose among were named, and the task has none to name.
        """
        self._search = self._search_of(env.action_space)
        self._search.bind(env)

    def reset(self, i: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation, info: Info) -> Action:
        """The best action; the one that changes nothing where none is better."""
        return self._search.act(observation, info)

    def explain(self) -> Considered | None:
        """What was tried and by what rule the action was chosen."""
        return self._search.explain() if isinstance(self._search, ExplainingAgent) else None

    def ranking(self, most: int) -> Considered | None:
        """The topology actions with the least worst loading by the forecast; None: it compared none."""
        return self._search.ranking(most) if isinstance(self._search, RankingAgent) else None

    def _search_of(self, space: gymnasium.Space[Any]) -> Agent:
        if isinstance(space, gymnasium.spaces.Discrete):
            return GreedyTopology(self._actions)
        if isinstance(space, gymnasium.spaces.Dict):
            return GreedyJoint(self._actions)
        if self._actions is not None:
            raise UsageError(
                "Agent 'greedy' can be limited to some actions on topology tasks (-T0-, ...) and joint ones only."
            )
        return GreedyDispatch()
