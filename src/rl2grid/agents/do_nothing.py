"""The agent that never intervenes: the paper's idle baseline."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rl2grid.agents.agent import Action, Actions, Info, Observation, no_intervention, repeated


class DoNothing:
    """Plays the action without effect at every decision."""

    name = "do-nothing"
    decides_side_by_side = True

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Remember which action changes nothing."""
        self._action = no_intervention(env.action_space)

    def reset(self, i: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation, info: Info) -> Action:
        """The action without effect."""
        return copy.deepcopy(self._action)

    def act_side_by_side(self, observations: NDArray[np.float32], masks: Callable[[], NDArray[np.bool_]]) -> Actions:
        """The action without effect in every environment."""
        return repeated(self._action, len(observations))
