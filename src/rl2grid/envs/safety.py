"""The six values that libraries of safe reinforcement learning expect of a step.

Safety-Gymnasium and OmniSafe read ``observation, reward, cost, terminated, truncated, info``. The cost is that of the
task's constraint, ``info["cost"]``: summed over the grid steps of the transition, as the reward is. What the
heuristic accrued before the first decision is in no step, but in ``info["reset_costs"]``.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorWrapper
from numpy.typing import NDArray

from rl2grid.arrays import Flags


class SafetyTuple(gymnasium.Wrapper[Any, Any, Any, Any]):
    """``step`` returns the cost, a float, behind the reward. Put it outside of all other wrappers."""

    def step(self, action: Any) -> tuple[Any, float, float, bool, bool, dict[str, Any]]:  # type: ignore[override]
        """Observation, reward, cost, terminated, truncated and info of a transition."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, float(reward), float(info["cost"]), terminated, truncated, info


class VectorSafetyTuple(VectorWrapper[Any, Any, Any, Any, Any]):
    """``step`` returns the costs, float64 [n], behind the rewards. Put it outside of all other wrappers.

    Where an episode ended, the cost is that of its last transition, and ``infos["final_observation"]``, the name that
    those libraries read, is ``infos["final_obs"]``.
    """

    def step(  # type: ignore[override]
        self, actions: Any
    ) -> tuple[Any, NDArray[Any], NDArray[np.float64], Flags, Flags, dict[str, Any]]:
        """Observations, rewards, costs, terminated, truncated and infos of a transition."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        costs = np.array(infos["cost"], np.float64)
        if "final_info" in infos:
            # The infos are those of the next episode already.
            costs = np.where(infos["_final_info"], infos["final_info"]["cost"], costs)
            infos = {**infos, "final_observation": infos["final_obs"], "_final_observation": infos["_final_obs"]}
        return observations, rewards, costs, terminated, truncated, infos
