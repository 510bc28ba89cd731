"""The agent that never intervenes: the paper's idle baseline."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium

from rl2grid.agents.agent import Action, Info, Observation, no_intervention


class DoNothing:
    """Plays the action without effect at every decision."""

    name = "do-nothing"

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Remember which action changes nothing."""
        self._action = no_intervention(env.action_space)

    def reset(self, i: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation, info: Info) -> Action:
        """The action without effect."""
        return copy.deepcopy(self._action)
